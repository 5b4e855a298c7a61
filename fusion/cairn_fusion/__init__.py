"""How images become evidence, and how a map is drawn."""
