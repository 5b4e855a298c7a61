"""Store in dictionaries: the obvious model that real stores are compared with; the sync simulator runs on it."""
