"""Profile "small": adaptive arithmetic coding of masks, counters and samples under mixed context models.

The content that it codes is `codec.octree`'s. Start with `small_profile`; `arithmetic_kernels` is the coder.
"""
