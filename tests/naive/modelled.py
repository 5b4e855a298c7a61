"""The slow, obvious twin of modelled streams: FORMAT.md 14 in plain integers, from the page and not from the code.

Like `entropy` in both directions: what to write is an argument, None when reading.

Leaves are (corner, edge): the first voxel and the number of voxels along an edge. Trees, in and out, are lists of
(child mask, leaf mask), one of each inner node, in the order of FORMAT.md 4.
"""

from tests.naive.entropy import Coder, Model, clip, digits, half_log

Corner = tuple[int, int, int]
Leaf = tuple[Corner, int]
Row = tuple[int, ...]

FACES = ((-1, 0, 0), (0, -1, 0), (0, 0, -1))
EDGES = ((-1, -1, 0), (-1, 0, -1), (0, -1, -1), (-1, -1, -1))
UPPER = ((1, 0, 0), (0, 1, 0), (0, 0, 1))
BESIDE = {
    **dict.fromkeys(FACES, 4),
    **dict.fromkeys(((-1, -1, 0), (-1, 0, -1), (0, -1, -1), (1, -1, 0), (1, 0, -1)), 2),
    **dict.fromkeys(((-1, 1, 0), (0, 1, -1), (-1, 0, 1), (0, -1, 1)), 2),
    (-1, -1, -1): 1,
}
"""Where rows may lie that speak for a row, and what each counts."""
KEPT = 1 << 40
HEAVY = 1 << 16


# --- Masks ------------------------------------------------------------------------------------------------------

ABSENT, INNER, LEAF = range(3)


def code_masks(coder: Coder, depth: int, tree: list[tuple[int, int]] | None) -> list[tuple[int, int]]:
    """The masks of a cell that is not empty: (child mask, leaf mask) of each inner node."""
    model = Model(coder)
    given = iter(tree or [])
    coded: list[tuple[int, int]] = []
    states: list[dict[Corner, int]] = [{(0, 0, 0): INNER}] + [{} for _ in range(depth)]
    nodes: list[Corner] = [(0, 0, 0)]
    for d in range(depth):
        inner: list[Corner] = []
        for node in nodes:
            masks = _code_node(model, states, d, depth, node, next(given) if tree is not None else (0, 0))
            coded.append(masks)
            inner += [_child(node, c) for c in range(8) if masks[0] & ~masks[1] & 1 << c]
        nodes = inner
    return coded


def _code_node(
    model: Model, states: list[dict[Corner, int]], d: int, depth: int, node: Corner, given: tuple[int, int]
) -> tuple[int, int]:
    """One node's (child mask, leaf mask); adds its children to the states."""
    g = min(depth - 1 - d, 3)
    upper = [_state(states, d, _moved(node, step)) for step in UPPER]
    exists = leaves = 0
    for c in range(8):
        child = _child(node, c)
        faces = digits(3, [_state(states, d + 1, _moved(child, step)) for step in FACES])
        edges = digits(3, [_state(states, d + 1, _moved(child, step)) for step in EDGES])
        ahead = digits(4, [upper[a] if c >> a & 1 else 3 for a in range(3)])
        opinions = [("F", faces, ahead), ("E", edges, faces), ("U", digits(3, upper), exists, c)]
        state = ABSENT
        if model.mixed([(*o, g, "there") for o in opinions], (g, "there"), given[0] >> c & 1):
            state = LEAF
            if d < depth - 1 and not model.mixed([(*o, g, "leaf") for o in opinions], (g, "leaf"), given[1] >> c & 1):
                state = INNER
            exists |= 1 << c
            leaves |= (state == LEAF) << c
        states[d + 1][child] = state
    assert exists
    return exists, leaves


def _state(states: list[dict[Corner, int]], d: int, node: Corner) -> int:
    """Of a node at depth d: 0 absent or outside the cell, 1 inner, 2 a leaf or inside one."""
    while d >= 0 and node not in states[d]:
        d, node = d - 1, (node[0] >> 1, node[1] >> 1, node[2] >> 1)
    return states[d][node] if d >= 0 else ABSENT


def _child(node: Corner, c: int) -> Corner:
    return 2 * node[0] + (c & 1), 2 * node[1] + (c >> 1 & 1), 2 * node[2] + (c >> 2)


def _moved(corner: Corner, step: Corner) -> Corner:
    return corner[0] + step[0], corner[1] + step[1], corner[2] + step[2]


# --- Counts -----------------------------------------------------------------------------------------------------


class Places:
    """Which leaf holds a voxel."""

    def __init__(self, leaves: list[Leaf]) -> None:
        self.leaves = {leaf: n for n, leaf in enumerate(leaves)}
        self.edges = sorted({edge for _, edge in leaves})

    def holder(self, voxel: Corner) -> int | None:
        """Number of the leaf, None if there is none."""
        x, y, z = voxel
        for e in self.edges:
            n = self.leaves.get(((x // e * e, y // e * e, z // e * e), e))
            if n is not None:
                return n
        return None

    def beside(self, leaf: Leaf, steps: tuple[Corner, ...]) -> list[int | None]:
        """The leaves that hold the voxels beside a leaf's first voxel."""
        return [self.holder(_moved(leaf[0], step)) for step in steps]

    def above(self, leaf: Leaf) -> int:
        """Whether something is one up along each axis from a leaf's last voxel."""
        (x, y, z), edge = leaf
        last = (x + edge - 1, y + edge - 1, z + edge - 1)
        return digits(2, [int(self.holder(_moved(last, step)) is not None) for step in UPPER])


def code_counts(coder: Coder, leaves: list[Leaf], counts: list[tuple[int, int]] | None) -> list[tuple[int, int]]:
    """(hits, misses) of each leaf."""
    model, places = Model(coder), Places(leaves)
    coded: list[tuple[int, int]] = []
    errors: list[int] = []
    for i, leaf in enumerate(leaves):
        faces, edges = places.beside(leaf, FACES), places.beside(leaf, EDGES)
        f, e = (digits(3, [0 if n is None else 1 + (coded[n][0] > 0) for n in beside]) for beside in (faces, edges))
        around = _Around(faces, edges, f, e, places.above(leaf), leaf[1])
        given = counts[i] if counts is not None else None
        hits = _code_hits(model, around, coded, None if given is None else given[0])
        misses, error = _code_misses(model, around, coded, errors, hits, None if given is None else given[1])
        coded.append((hits, misses))
        errors.append(error)
    return coded


class _Around:
    """What a leaf's counts are guessed from."""

    def __init__(self, faces: list[int | None], edges: list[int | None], f: int, e: int, above: int, edge: int) -> None:
        self.faces, self.edges, self.F, self.E, self.above = faces, edges, f, e, above
        self.big = edge > 1
        self.size = 0 if edge == 1 else 1 if edge == 2 else 2


def _code_hits(model: Model, around: _Around, coded: list[tuple[int, int]], given: int | None) -> int:
    hit = [coded[n][0] for n in around.faces + around.edges if n is not None and coded[n][0] > 0]
    k = len(hit)
    h = (2 * sum(hit) + k) // (2 * k) if k else 0
    missed = [coded[n][1] for n in around.faces if n is not None]
    m = sum(missed) // len(missed) if missed else 0
    opinions = [
        ("hit 0", around.F, around.above, around.big),
        ("hit 1", around.F, around.E, around.big),
        ("hit 2", min(h, 15), around.above, min(m, 7), k),
    ]
    if not model.mixed(opinions, "hit", int(bool(given))):
        return 0
    wanted = None if given is None else given - 1 - h
    return 1 + h + model.number("hits", [min(h, 60), (k, min(h, 7)), (min(m, 20), around.above)], 0, wanted)


def _code_misses(
    model: Model,
    around: _Around,
    coded: list[tuple[int, int]],
    errors: list[int],
    hits: int,
    given: int | None,
) -> tuple[int, int]:
    """Misses, and their error."""
    faces = [n for n in around.faces if n is not None]
    edges = [n for n in around.edges if n is not None]
    if len(faces) == 3:
        g = sorted(coded[n][1] for n in faces)[1]
    else:
        g = coded[(faces or edges)[-1]][1] if faces or edges else 0
    few = min(hits, 2)
    s = digits(8, [7 if n is None else clip(coded[n][1] - g, -3, 3) + 3 for n in around.faces])
    c = digits(4, [3 if n is None else clip(coded[n][1] - g, -1, 1) + 1 for n in around.edges])
    e = sum(errors[n] for n in faces)
    before = errors[-1] if errors else 0
    opinions = [
        (s, few),
        (c, around.size),
        (min(g, 40), few, around.above, around.size),
        (min(e, 15), len(faces), around.F, before),
    ]
    rows = (few, len(faces), around.big)
    number = model.number("misses", opinions, rows, None if given is None else given - g)
    return g + number, min(abs(number), 7)


# --- Channels ---------------------------------------------------------------------------------------------------


def code_channel(
    coder: Coder,
    leaves: list[Leaf],
    hits: list[int],
    before: dict[int, int],
    plane_count: int,
    is_temperature: bool,
    rows: dict[int, Row] | None,
) -> dict[int, Row]:
    """The rows of a channel by leaf, the weight last. `before`: weights of the channel before by leaf."""
    model, places = Model(coder), Places(leaves)
    there = _code_presence(model, places, leaves, hits, before, rows)
    given = [rows[leaf] for leaf in there] if rows is not None else None
    beside = _rows_beside([leaves[leaf][0] for leaf in there])
    references = [before.get(leaf, 0) or hits[leaf] for leaf in there]
    weights = _code_weights(model, beside, references, None if given is None else [row[-1] for row in given])
    plain = 1 if is_temperature else plane_count - 1
    sums, numbers = _code_values(model, beside, weights, plain, given)
    if is_temperature:
        first = [row[0] for row in numbers]
        squares = _code_squares(model, beside, weights, sums, first, given)
        sums = [[*row, square] for row, square in zip(sums, squares, strict=True)]
    return {leaf: (*row, weight) for leaf, row, weight in zip(there, sums, weights, strict=True)}


def _code_presence(
    model: Model,
    places: Places,
    leaves: list[Leaf],
    hits: list[int],
    before: dict[int, int],
    rows: dict[int, Row] | None,
) -> list[int]:
    there: dict[int, None] = {}
    for n, leaf in enumerate(leaves):
        if leaf[1] == 1:
            faces = digits(2, [int(f in there) for f in places.beside(leaf, FACES)])
            if model.one(("row", min(hits[n], 3), before.get(n, 0) > 0, faces), int(rows is not None and n in rows)):
                there[n] = None
    return list(there)


def _rows_beside(corners: list[Corner]) -> list[list[tuple[int, int]]]:
    """N(s) of each row s: (row, what it counts)."""
    number = {corner: s for s, corner in enumerate(corners)}
    return [
        [
            (number[place], counts)
            for step, counts in BESIDE.items()
            if number.get(place := _moved(corner, step), len(corners)) < s
        ]
        for s, corner in enumerate(corners)
    ]


def _code_weights(
    model: Model, beside: list[list[tuple[int, int]]], references: list[int], given: list[int] | None
) -> list[int]:
    weights: list[int] = []
    kept: list[int] = []
    for s, r in enumerate(references):
        n = len(beside[s])
        e = sum(kept[b] for b, _ in beside[s])
        error = min(half_log(4 * e // n), 40) if n else 41
        opinions = [min(r, 60), (min(n, 7), min(r, 15)), (error, min(r, 15))]
        number = model.number("weight", opinions, 0, None if given is None else given[s] - r)
        weights.append(r + number)
        kept.append(min(abs(number), KEPT))
    return weights


def _code_values(
    model: Model, beside: list[list[tuple[int, int]]], weights: list[int], planes: int, given: list[Row] | None
) -> tuple[list[list[int]], list[list[int]]]:
    """(sums, numbers) of each row."""
    sums: list[list[int]] = []
    numbers: list[list[int]] = []
    for s, w in enumerate(weights):
        sums.append([])
        numbers.append([])
        for p in range(planes):
            counted = [(b, c) for b, c in beside[s] if 0 < weights[b] < HEAVY and sums[b][p] < KEPT]
            guess, error, spread, n = _value_guess(
                counted,
                [row[p] if p < len(row) else 0 for row in sums],
                [row[p] if p < len(row) else 0 for row in numbers],
                weights,
                w,
            )
            last = numbers[s][-1] if p else None
            previous = 0 if last is None else 2 * min(half_log(min(abs(last), KEPT)), 30) + (last < 0)
            opinions = [(min(w, 23), error), (previous, min(error // 2, 15)), (spread, min(half_log(w), 11))]
            wanted = None if given is None else given[s][p] - guess
            numbers[s].append(model.number(("value", p), opinions, min(n, 3), wanted))
            sums[s].append(guess + numbers[s][p])
    return sums, numbers


def _value_guess(
    counted: list[tuple[int, int]], sums: list[int], numbers: list[int], weights: list[int], w: int
) -> tuple[int, int, int, int]:
    """(guess, E, D, n) of a row's sum in one plane."""
    n = len(counted)
    if n == 0 or w >= HEAVY:
        return 0, 47, 40, 0
    total = sum(c * sums[b] for b, c in counted)
    weight = sum(c * weights[b] for b, c in counted)
    guess = total // weight * w + total % weight * w // weight
    error = min(half_log(4 * sum(min(abs(numbers[b]), KEPT) for b, _ in counted) // n), 46)
    means = [4 * sums[b] // weights[b] for b, _ in counted]
    return guess, error, 40 if n == 1 else min(half_log(max(means) - min(means)), 39), n


def _code_squares(
    model: Model,
    beside: list[list[tuple[int, int]]],
    weights: list[int],
    sums: list[list[int]],
    first: list[int],
    given: list[Row] | None,
) -> list[int]:
    """The square sums; `first`: the numbers of plane 0."""
    squares: list[int] = []
    kept: list[int] = []
    for s, w in enumerate(weights):
        counted = [(b, c) for b, c in beside[s] if 0 < weights[b] < HEAVY]
        n, v = len(counted), clip(w, 1, HEAVY)
        x = 63
        if n:
            total = sum(c * kept[b] for b, c in counted)
            x = min(half_log(total // sum(c * weights[b] for b, c in counted) * v), 62)
        o = min(half_log(min(abs(first[s]), KEPT) // v), 30)
        guess = 0
        if 0 < w < HEAVY and sums[s][0] // w < 1 << 20:
            q = sums[s][0] // w
            guess = q * q * w + 2 * q * (sums[s][0] - q * w)
        opinions = [(min(w, 15), x), (o, min(w, 15)), (min(half_log(w), 20), min(n, 7))]
        number = model.number("square", opinions, min(w, 3), None if given is None else given[s][1] - guess)
        squares.append(guess + number)
        kept.append(min(abs(number), KEPT))
    return squares
