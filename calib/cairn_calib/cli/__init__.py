"""Commands of `cairn calib`: corners, solve, report, convert and thermal.

They read files, call one function of a room below and print. Start with `main`.
"""
