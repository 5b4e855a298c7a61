"""Servers that share one database, killed, stopped and cut off while robots push through any of them."""
