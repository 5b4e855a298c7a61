"""URLs of a robot's network: the ROS_DOMAIN_ID of their query."""

import pytest

from cairn_client.links.link_url import DOMAIN_MAX, domain_of


@pytest.mark.parametrize(("text", "domain"), [("0", 0), ("7", 7), ("232", DOMAIN_MAX), ("00000000012", 12)])
def test_a_domain_is_all_of_its_digits(text: str, domain: int) -> None:
    assert domain_of(f"domain={text}") == domain


@pytest.mark.parametrize("text", ["233", "-1", "1.0", "x", "", "%C2%B2", "0000000019999", "9" * 5000])
def test_what_is_no_domain_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        domain_of(f"domain={text}")


@pytest.mark.parametrize("query", ["", "domain", "key=1", "domain=1&key=2", "domain=1&domain=2"])
def test_a_query_is_a_domain_and_nothing_else(query: str) -> None:
    with pytest.raises(ValueError):
        domain_of(query)
