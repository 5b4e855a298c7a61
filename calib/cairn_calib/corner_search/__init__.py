"""Boards searched in a camera's images: a document and a picture for each; and boards whose tags name their corners.

How a plain board is found in one image is left to `board`, the command line to `cli`. Start with `image_search`, the
work of one image; `search_workers` spreads it over the cores, `corner_folder` keeps what is done. `coded_search` is the
detection of boards with tags; `tag_layout` says where their tags are, `tag_detection` finds them.
"""
