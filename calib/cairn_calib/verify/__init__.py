"""Verification of a rig on circle targets: chapter V of Kocmanova et al., with its Table 2.

Fusing the images that it needs is left to `cairn_fusion`. Start with `verification`.
"""
