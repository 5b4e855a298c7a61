"""Images as evidence, and the map drawn over an image.

Cameras come from `cairn_calib`, the map from `cairn_map`. Start with `recording.scan` (what goes in),
`mapping.integrate` (evidence) and `transfer.transfer` (Eq. 5-6, from one camera to another).
"""
