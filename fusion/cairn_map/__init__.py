"""What a map is: grid, evidence, octree code, commits and the frames on the wire."""
