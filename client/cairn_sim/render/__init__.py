"""Images of a scene: colour, thermal, range with amplitude, with noise and with exact truth.

Where the cameras are is left to `robots`. Start with `render`.
"""
