"""A strict reader of Prometheus's text format: what it does not know is an error."""

import re
from dataclasses import dataclass, field

NAME = r"[a-zA-Z_:][a-zA-Z0-9_:]*"
LABEL = re.compile(r'([a-zA-Z_][a-zA-Z0-9_]*)="((?:[^"\\\n]|\\[\\"n])*)"(?:,|$)')
SAMPLE = re.compile(rf"({NAME})(?:\{{(.*)\}})? (\S+)")
SUFFIXES = {"histogram": ("_bucket", "_sum", "_count"), "counter": ("",), "gauge": ("",)}

Labels = frozenset[tuple[str, str]]


@dataclass
class Family:
    """One name with its samples."""

    kind: str
    samples: dict[tuple[str, Labels], float] = field(default_factory=dict)


def families_of(text: str) -> dict[str, Family]:
    """All families of a page.

    Raises:
        AssertionError: it is not as the format and Prometheus's advice on names want it.
    """
    assert text.endswith("\n")
    found: dict[str, Family] = {}
    lines = iter(text.removesuffix("\n").split("\n"))
    name = helped = ""
    for line in lines:
        if match := re.fullmatch(rf"# HELP ({NAME}) (\S.*)", line):
            helped = match[1]
        elif match := re.fullmatch(rf"# TYPE ({NAME}) (counter|gauge|histogram)", line):
            name = match[1]
            assert name == helped and name not in found, line
            found[name] = Family(match[2])
            _check_name(name, match[2])
        else:
            _take_sample(line, name, found[name])
    for name, family in found.items():
        if family.kind == "histogram":
            _check_histogram(name, family)
    return found


def value(text: str, name: str, **labels: str) -> float:
    """One sample; 0 if there is none."""
    family = next(f for n, f in families_of(text).items() if name.startswith(n) and name[len(n) :] in SUFFIXES[f.kind])
    return family.samples.get((name, frozenset(labels.items())), 0.0)


def _check_name(name: str, kind: str) -> None:
    assert name.startswith(("cairn_", "process_"))
    assert name.endswith("_total") == (kind == "counter"), name
    if kind != "counter":
        units = ("_bytes", "_seconds", "_info", "_commits", "_length", "_fds")
        assert name.endswith(units), name


def _take_sample(line: str, name: str, family: Family) -> None:
    match = SAMPLE.fullmatch(line)
    assert match, line
    assert match[1] in [name + suffix for suffix in SUFFIXES[family.kind]], line
    inner = match[2] or ""
    labels = LABEL.findall(inner)
    assert "".join(f'{key}="{text}",' for key, text in labels).removesuffix(",") == inner, line
    assert len({key for key, _ in labels}) == len(labels)
    key = (match[1], frozenset((key, re.sub(r"\\(.)", _unescaped, text)) for key, text in labels))
    assert key not in family.samples, line
    family.samples[key] = float(match[3])
    assert family.samples[key] >= 0


def _unescaped(match: re.Match[str]) -> str:
    return "\n" if match[1] == "n" else match[1]


def _check_histogram(name: str, family: Family) -> None:
    series: dict[Labels, list[tuple[float, float]]] = {}
    for (sample, labels), number in family.samples.items():
        if sample == f"{name}_bucket":
            end = dict(labels)["le"]
            rest = frozenset(pair for pair in labels if pair[0] != "le")
            series.setdefault(rest, []).append((float(end.replace("+Inf", "inf")), number))
    for labels, buckets in series.items():
        ends, counts = zip(*sorted(buckets), strict=True)
        assert ends[-1] == float("inf")
        assert list(counts) == sorted(counts)
        assert counts[-1] == family.samples[f"{name}_count", labels]
        assert (f"{name}_sum", labels) in family.samples
