"""Point clouds in files: each file a sweep, its points without a raster.

Start with `cloud_folder`; `cloud_file` reads one file of any form.
"""
