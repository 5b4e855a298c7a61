"""The operator's page in a real browser.

A package, so that the browser ends with its tests: others have event loops of their own.
"""
