"""Boards searched in many images: a document and a picture for each, in processes, resumed where a run was cut.

How a board is found in one image is left to `board`, the command line to `cli`. Start with `image_search`, the work of
one image; `search_workers` spreads it over the cores, `corner_folder` keeps what is done.
"""
