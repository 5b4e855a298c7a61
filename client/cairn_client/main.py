"""One live map, built by a team of robots.

Run `cairn COMMAND --help` for what a command does. Results go to standard output, everything else to standard error.
"""

import ast
import sys
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points, version
from importlib.util import find_spec
from pathlib import Path

from cairn_map.errors import DONE, EXIT_CODES, FAILED, INTERRUPTED, USAGE, CairnError, exit_code_of
from cairn_map.kernels.numba_runtime import keep_interrupts_out_of_kernels, show_compiling

GROUP = "cairn.commands"


def main(argv: list[str] | None = None) -> int:
    """Run the command named first, found through the entry points of whatever is installed."""
    arguments = sys.argv[1:] if argv is None else argv
    commands = {point.name: point for point in entry_points(group=GROUP)}
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        sys.stdout.write(_help(commands))
        return DONE if arguments else USAGE
    if arguments[0] == "--version":
        sys.stdout.write(f"cairn {version('cairn-robotics')}\n")
        return 0
    name, *rest = arguments
    if name not in commands:
        sys.stderr.write(f"cairn: there is no command {name!r}; there are {', '.join(sorted(commands))}\n")
        return USAGE
    try:
        return _run(commands[name], rest)
    except CairnError as exc:
        sys.stderr.write(f"cairn {name}: {exc.message} [{exc.kind}]\n")
        return exit_code_of(exc)
    except KeyboardInterrupt:
        sys.stderr.write("\n")
        return INTERRUPTED
    except BrokenPipeError:
        sys.stderr.close()  # the reader of our output went away; nothing is left to tell it
        return 0


def _run(point: EntryPoint, arguments: list[str]) -> int:
    # Here and not above: it imports Numba, and the list of commands needs none.
    from cairn_map.kernels.kernel_cache import home_folder, keep_kernels

    keep_kernels(home_folder())
    try:
        module = import_module(point.module)
    except ModuleNotFoundError as exc:
        if not exc.name or exc.name.startswith("cairn_"):
            raise
        extra = point.extras[0] if point.extras else "all"
        sys.stderr.write(
            f'cairn {point.name}: {exc.name} is not installed; get it with pip install "cairn-robotics[{extra}]"\n'
        )
        return FAILED
    show_compiling()
    keep_interrupts_out_of_kernels()
    result: int = module.main(arguments)
    return result


def _help(commands: dict[str, EntryPoint]) -> str:
    lines = [f"usage: cairn COMMAND ...\n\n{__doc__}\n"]
    lines += [f"  {name:<12} {_first_line(point.module)}" for name, point in sorted(commands.items())]
    return "\n".join([*lines, "", EXIT_CODES]) + "\n"


def _first_line(module: str) -> str:
    """First line of a module's docstring, without importing what the module needs."""
    spec = find_spec(module)
    if spec is None or spec.origin is None:
        return ""
    text = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


if __name__ == "__main__":
    sys.exit(main())
