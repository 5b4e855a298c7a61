"""Points of the range camera on other cameras' pixels (Eq. 5-6), with their covariance.

What is fused there is left to `image_fusion` and `mapping`. Start with `transfer`.
"""
