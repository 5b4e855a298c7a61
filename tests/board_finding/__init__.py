"""Whether boards are found in hard images, and never where there is none."""
