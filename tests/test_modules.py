"""Shape of modules and functions: STYLE.md's "The house" and "comments", held by reading the sources.

$ python -m tests.test_modules      # the figures: modules, functions, comments
"""

import ast
import re
import statistics
import sys
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from tests.fixtures.sources import docstrings, imports, modules, tree_of

FUNCTION_LINES_MAX = 60
"""Lines of a function, without its docstring and its comments: one screen."""
SPLINTER_LINES = 50
"""A module below this with a single reader is a part of that reader."""
COMMENTS_MIN = 8.0
"""Comment lines per 100 lines of code, of each kernel module and each pipeline."""
CODE_MIN = 20
"""Lines of code below which a module's docstring is comment enough."""
TO_BE_REWRITTEN = ("cairn_map/codec/", "cairn_fusion/mapping/", "cairn_fusion/transfer/")
"""Kernels that get their comments with their rewrite for bricks."""
PIPELINES = (
    "cairn_calib/board/corner_detection.py",
    "cairn_calib/board/corner_gates.py",
    "cairn_calib/board/corner_refinement.py",
    "cairn_calib/board/grid_fit.py",
    "cairn_calib/board/saddle_grid.py",
    "cairn_calib/board/saddle_points.py",
    "cairn_calib/diagnosis/next_image.py",
    "cairn_calib/board/discs/disc_grid.py",
    "cairn_calib/board/discs/disc_lattice.py",
    "cairn_calib/board/discs/disc_outline.py",
    "cairn_calib/rig/brown.py",
    "cairn_calib/rig/projection_uncertainty.py",
    "cairn_calib/solve/adjustment.py",
    "cairn_calib/solve/camera_alone.py",
    "cairn_calib/solve/corner_residuals.py",
    "cairn_calib/solve/pixel_pattern.py",
    "cairn_calib/solve/range_residuals.py",
    "cairn_calib/solve/rig_start.py",
    "cairn_calib/solve/solve.py",
    "cairn_calib/solve/zhang.py",
    "cairn_calib/thermal/flat_field.py",
    "cairn_calib/thermal/object_temperature.py",
    "cairn_calib/thermal/response_fit.py",
    "cairn_calib/verify/verification.py",
    "cairn_client/relay/round.py",
    "cairn_client/replica/outbox.py",
    "cairn_client/robot/alignment.py",
    "cairn_client/robot/robot.py",
    "cairn_client/robot/rounds.py",
    "cairn_client/sync/exchange.py",
    "cairn_client/sync/sync.py",
    "cairn_fusion/image_fusion/dense_depth.py",
    "cairn_fusion/image_fusion/surface.py",
    "cairn_fusion/mapping/free_space.py",
    "cairn_fusion/mapping/integrate.py",
    "cairn_fusion/mapping/ray_casting.py",
    "cairn_fusion/mapping/samples.py",
    "cairn_fusion/transfer/transfer.py",
    "cairn_fusion/view/overlay.py",
    "cairn_fusion/view/telepresence.py",
    "cairn_map/codec/view_code.py",
    "cairn_map/files/octomap.py",
    "cairn_map/render/map_render.py",
    "cairn_server/folding/folding.py",
    "cairn_server/store/sqlite/writer.py",
    "cairn_server/sync/cell_changes.py",
    "cairn_server/sync/checks/check_pool.py",
    "cairn_server/sync/missing.py",
    "cairn_server/sync/pushes.py",
    "cairn_server/sync/replies.py",
)
"""Long algorithms outside of kernels."""
DIRECTIVE = re.compile(r"#\s*(?:noqa|type:|pyright|ruff)")


def functions() -> Iterator[tuple[str, ast.FunctionDef | ast.AsyncFunctionDef, list[str]]]:
    """Every function with the name of its module and its source lines."""
    for module, path in modules():
        lines = path.read_text(encoding="utf-8").splitlines()
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield module, node, lines[node.lineno - 1 : node.end_lineno]


def code_lines(node: ast.FunctionDef | ast.AsyncFunctionDef, lines: list[str]) -> int:
    """Lines of a function without its docstring and its comments."""
    first = node.body[0]
    is_documented = ast.get_docstring(node, clean=False) is not None
    docstring = (first.end_lineno or first.lineno) - first.lineno + 1 if is_documented else 0
    return len(lines) - docstring - sum(line.strip().startswith("#") for line in lines)


@cache
def comments_and_code(path: Path) -> tuple[int, int]:
    """Lines that have a comment, and lines that have code; docstrings are neither."""
    prose = {
        line for text in docstrings(tree_of(path)) for line in range(text.lineno, (text.end_lineno or text.lineno) + 1)
    }
    comments: set[int] = set()
    code: set[int] = set()
    blank = {tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING, tokenize.ENDMARKER}
    with path.open("rb") as file:
        for token in tokenize.tokenize(file.readline):
            if token.type == tokenize.COMMENT:
                if not DIRECTIVE.match(token.string):
                    comments.add(token.start[0])
            elif token.type not in blank:
                code.update(range(token.start[0], token.end[0] + 1))
    return len(comments), len(code - prose)


def share(path: Path) -> float:
    """Comment lines per 100 lines of code."""
    comments, code = comments_and_code(path)
    return 100 * comments / max(1, code)


def readers() -> dict[str, set[str]]:
    """Modules that import each module, by dotted name."""
    names = {module.removesuffix(".py").replace("/", ".") for module, _ in modules()}
    found: dict[str, set[str]] = defaultdict(set)
    for module, path in modules():
        for name in imports(path) & names:
            found[name].add(module)
    return found


def test_a_function_fits_a_screen() -> None:
    long = {f"{module}: {node.name}": code_lines(node, lines) for module, node, lines in functions()}
    assert {name: count for name, count in long.items() if count > FUNCTION_LINES_MAX} == {}


def test_a_small_module_with_one_reader_is_a_part_of_it() -> None:
    by = readers()
    small = []
    for module, path in modules():
        is_small = len(path.read_text(encoding="utf-8").splitlines()) < SPLINTER_LINES
        if path.name != "__init__.py" and is_small and len(by[module.removesuffix(".py").replace("/", ".")]) == 1:
            small.append(module)
    assert small == []


def test_no_literal_tuple_is_splatted_into_a_call() -> None:
    splats = [
        f"{module}:{node.lineno}"
        for module, path in modules()
        for node in ast.walk(tree_of(path))
        if isinstance(node, ast.Call)
        and any(isinstance(one, ast.Starred) and isinstance(one.value, ast.Tuple | ast.List) for one in node.args)
    ]
    assert splats == []


def test_kernels_and_pipelines_carry_their_map_in_comments() -> None:
    known = dict(modules())
    assert [name for name in PIPELINES if name not in known] == []
    kernels = [name for name in known if name.endswith("_kernels.py") and not name.startswith(TO_BE_REWRITTEN)]
    long = [name for name in (*kernels, *PIPELINES) if comments_and_code(known[name])[1] >= CODE_MIN]
    bare = {name: round(share(known[name]), 1) for name in long if share(known[name]) < COMMENTS_MIN}
    assert bare == {}


def test_public_classes_have_one_meaning_each() -> None:
    found: dict[str, list[str]] = defaultdict(list)
    for module, path in modules():
        for node in tree_of(path).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                found[node.name].append(module)
    assert {name: where for name, where in found.items() if len(where) > 1} == {}


def figures() -> Iterator[str]:
    """The figures of the whole tree, a line each."""
    sizes = sorted(
        len(path.read_text(encoding="utf-8").splitlines()) for _, path in modules() if path.name != "__init__.py"
    )
    lengths = sorted(node.end_lineno - node.lineno + 1 for _, node, _ in functions() if node.end_lineno)
    for what, values in (("modules", sizes), ("functions", lengths)):
        p90 = values[round(0.9 * (len(values) - 1))]
        spread = f"median {statistics.median(values):g}, p90 {p90}, max {values[-1]}"
        yield f"{len(values)} {what}, {sum(values)} lines; {spread}"
    for what, ending in (("all modules", ".py"), ("kernels", "_kernels.py")):
        counted = [comments_and_code(path) for module, path in modules() if module.endswith(ending)]
        per = 100 * sum(comments for comments, _ in counted) / sum(code for _, code in counted)
        yield f"{per:.1f} comments per 100 lines of code, {what}"


if __name__ == "__main__":
    sys.stdout.write("".join(f"{line}\n" for line in figures()))
