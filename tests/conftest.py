"""The slowest file comes first, so that the other workers have the rest to do meanwhile."""

import pytest


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.get_closest_marker("image") is None)
