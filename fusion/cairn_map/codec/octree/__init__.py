"""Parts of a cell's bytes: header, child masks in breadth-first order, and one stream per channel.

The choice of a profile is left to `codec.cell_code`. Start with `octree`, then `cell_head` and `channel_streams`.
"""
