"""Packages that cairn is installed with: their licences, all listed and none a GPL, and the locks of the image."""

import json
import re
import tomllib
from importlib.metadata import Distribution, distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
NODE_WHEEL = re.findall(r'^NODE_WHEEL = "(.+)"$', (ROOT / "server/console/build_console.py").read_text(), re.MULTILINE)[
    0
]
PAGE = ROOT / "docs" / "licences.md"
FAMILIES = {
    "MIT": r"MIT(-0|-CMU)?( License)?",
    "BSD": r"(BSD|BSD-[23]-Clause|0BSD)( .*)?",
    "Apache-2.0": r"Apache[- ](Software License|2\.0( WITH LLVM-exception)?)",
    "PSF-2.0": r"PSF-2\.0|Python Software Foundation License",
    "MPL-2.0": r"MPL-2\.0|Mozilla Public License 2\.0 \(MPL 2\.0\)",
    "EPL-2.0": r"Eclipse Public License 2\.0 \(EPL-2\.0\)|EPL-2\.0",
    "ISC": r"ISC( License \(ISCL\))?",
    "Zlib": r"Zlib",
    "CC0-1.0": r"CC0-1\.0",
    "any OSI": r"any-OSI",
}
"""Licences that a dependency may have, and how packages state them."""


def name_of(text: str) -> str:
    """A package's name as all indexes write it."""
    return re.sub(r"[-_.]+", "-", text).lower()


def needed(*roots: str) -> dict[str, Distribution]:
    """Packages that these requirements install here, by name, without cairn itself."""
    found: dict[str, Distribution] = {}
    todo, seen = [Requirement(root) for root in roots], set()
    while todo:
        requirement = todo.pop()
        name, extras = name_of(requirement.name), frozenset(requirement.extras)
        if (name, extras) in seen:
            continue
        seen.add((name, extras))
        found[name] = distribution(name)
        parts = [Requirement(text) for text in found[name].requires or ()]
        todo += [p for p in parts if p.marker is None or any(p.marker.evaluate({"extra": e}) for e in extras | {""})]
    del found["cairn-robotics"]
    return found


def stated(package: Distribution) -> list[str]:
    """Licences that a package states: as an expression, else by its classifiers, else in words."""
    meta = package.metadata
    if meta["License-Expression"]:
        return [part.strip() for part in re.split(r" AND | OR |[()]", meta["License-Expression"]) if part.strip()]
    classifiers = [text for text in meta.get_all("Classifier") or () if text.startswith("License ::")]
    return [text.rpartition(" :: ")[2] for text in classifiers] or [(meta["License"] or "none stated").strip()[:60]]


def families(texts: list[str]) -> set[str]:
    """Families of licences; a text of none of them stays as it is."""

    def family(text: str) -> str:
        return next((name for name, pattern in FAMILIES.items() if re.fullmatch(pattern, text)), text)

    return {family(text) for text in texts}


def listed() -> dict[str, set[str]]:
    """Licences by package, as the page lists them."""
    lines = re.findall(r"^\| `([a-z0-9-]+)` \| ([^|]+) \|", PAGE.read_text(), re.MULTILINE)
    return {name: set(text.strip().split(", ")) for name, text in lines}


def locked(name: str = "server.lock") -> set[tuple[str, str]]:
    """Packages of the container image, each with its version (or two, by the version of Python)."""
    found = re.findall(r"^([a-z0-9._-]+)==(\S+)", (ROOT / "docker" / name).read_text(), re.MULTILINE)
    return {(name_of(package), version) for package, version in found}


def asked(*extras: str) -> list[Requirement]:
    """Requirements of the project, and of these extras of it."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    texts = [*project["dependencies"], *(text for name in extras for text in project["optional-dependencies"][name])]
    return [Requirement(text) for text in texts]


def test_every_package_has_a_licence_that_the_page_allows() -> None:
    found = {name: families(stated(package)) for name, package in needed("cairn-robotics[all]").items()}
    assert len(found) > 40
    assert {name: licences - FAMILIES.keys() for name, licences in found.items() if licences - FAMILIES.keys()} == {}


def test_the_page_lists_what_the_image_holds_and_what_we_ask_for() -> None:
    names = {name_of(requirement.name) for requirement in asked("robot", "live", "server", "report")}
    assert (names | {name for name, _ in locked()}) - listed().keys() == set()


def test_the_page_states_what_the_locked_packages_state() -> None:
    found, page = needed("cairn-robotics[all]"), listed()
    assert set().union(*page.values()) <= FAMILIES.keys()
    same = {name for name, version in locked() if name in found and found[name].version == version}
    assert {name: families(stated(found[name])) for name in same} == {name: page[name] for name in same}


def test_packages_that_build_the_page_have_such_licences_and_none_is_in_it() -> None:
    packages = json.loads((ROOT / "server/console/package-lock.json").read_text())["packages"]
    found = {path: package for path, package in packages.items() if path}
    assert {
        path: package["license"]
        for path, package in found.items()
        if not families([package["license"]]) <= FAMILIES.keys()
    } == {}
    assert [path for path, package in found.items() if not package.get("dev")] == []


@pytest.mark.parametrize(
    "text", ["GPL-3.0-only", "LGPL-2.1-or-later", "GNU General Public License v3 (GPLv3)", "AGPL-3.0"]
)
def test_no_gpl_is_allowed(text: str) -> None:
    assert families([text]) == {text}


def test_the_locks_fulfil_what_is_asked_for_and_have_a_hash_for_everything() -> None:
    build = tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]
    lines = (ROOT / "docker/build.in").read_text().splitlines()
    sources = [Requirement(line) for line in lines if not line.startswith("#")]
    assert {Requirement(text) for text in (*build, NODE_WHEEL)} == set(sources), "`make lock` reads build.in"
    for name, requirements in (
        ("server.lock", asked("server")),
        ("scale.lock", asked("server", "postgresql")),
        ("build.lock", sources),
    ):
        text, versions = (ROOT / "docker" / name).read_text(), locked(name)
        for requirement in requirements:
            found = [version for package, version in versions if package == name_of(requirement.name)]
            assert found and all(map(requirement.specifier.contains, found)), f"{requirement}: run `make lock`"
        entries = re.split(r"^(?=[a-z0-9])", text, flags=re.MULTILINE)[1:]
        assert len(entries) >= len(versions) > 5
        assert [entry for entry in entries if "--hash=sha256:" not in entry] == []
