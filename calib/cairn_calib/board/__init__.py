"""Calibration boards in images: corners found, ordered, refined and given a polarity, in every spectrum.

Estimating cameras from them is left to `solve`. Start with `corner_detection`, or for discs with `discs`;
`corner_refinement` is the sub-pixel step, `polarity` settles whether a camera sees print dark or bright.
"""
