"""Slow, obvious twins of kernels, codecs and protocols, written from the documents and not from the code.

A module per noun: evidence, columns, octree, cell_code, entropy, modelled and wire (maps and bytes), asker (a robot),
queries, hot_spots, sight, rays and ground (voxels), views, images and raycast (images), octomap (another program's
file).
"""
