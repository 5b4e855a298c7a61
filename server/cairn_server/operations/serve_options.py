"""Options of `cairn serve`: flags for daily use, a settings file and the environment for the rest.

A flag counts before the environment, the environment before the settings file, and the file before the default. The
file is TOML and has the names of `cairn_server.settings`:

    keep_evidence_s = 604_800
    body_bytes_per_s = 500
    quotas.bytes_per_day = 1_000_000_000

In the environment the same are CAIRN_KEEP_EVIDENCE_S, CAIRN_BODY_BYTES_PER_S and CAIRN_QUOTAS__BYTES_PER_DAY.
"""

import argparse
import os
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
    SettingsError,
)

from cairn_map.errors import EXIT_CODES, BadInputError, complaint_text
from cairn_server.http.middleware.log_format import add_log_format
from cairn_server.metrics import program_version
from cairn_server.settings import Settings
from cairn_server.store.private_files import warn_if_open

PREFIX, BETWEEN = "CAIRN_", "__"
MEGABYTE = 1 << 20
FILE_BYTES_MAX = MEGABYTE
"""Largest file of a secret or of settings."""
WIDTH = 110
FLAGS = {
    "folder": ("--data", "DIR"),
    "store": ("--store", "URL"),
    "objects": ("--objects", "URL"),
    "host": ("--host", "ADDRESS"),
    "port": ("--port", "PORT"),
    "tls_cert": ("--tls-cert", "FILE"),
    "tls_key": ("--tls-key", "FILE"),
    "stable_after_s": ("--stable-after", "SECONDS"),
    "keep_evidence_s": ("--keep-evidence", "SECONDS"),
    "branch_expiry_s": ("--branch-expiry", "SECONDS"),
    "upstream": ("--upstream", "URL"),
    "drain_s": ("--drain", "SECONDS"),
}
"""Flag and name of the value of each setting that is given on the command line as it is."""
SECRETS = {
    "admin_token": "--admin-token-file",
    "enrolment_token": "--enrolment-token-file",
    "upstream_token": "--upstream-token-file",
}
"""Flag of each secret: the file that holds it, since other users see a process's arguments."""
OTHER_FLAGS = {
    "metrics_open": "--metrics-open",
    "folding": "--no-fold",
    "trusted_servers": "--trust-server",
    "public_urls": "--public-url",
}
REPEATED = frozenset({"trusted_servers", "public_urls"})
"""Settings whose flags may be repeated; their values are separated by spaces."""
MOVED = {
    "--limit-concurrency": ("limit_concurrency", 1),
    "--min-rate": ("body_bytes_per_s", 1),
    "--disk-free-min": ("disk_free_min_bytes", MEGABYTE),
    "--fold-lag-max": ("fold_lag_max_s", 1),
    "--quota-commits": ("quotas.commits_per_minute", 1),
    "--quota-bytes": ("quotas.bytes_per_day", 1),
    "--quota-cells": ("quotas.cells_per_day", 1),
    "--quota-commit-cells": ("quotas.cells_per_commit", 1),
    "--map-extent": ("quotas.map_extent_m", 1),
}
"""Setting in which each removed flag lives on, and what its value is to be multiplied by."""
NOT_FROM_ENVIRONMENT = frozenset({"folder", "host", "port"})
"""Kubernetes sets CAIRN_PORT=tcp://... in every pod next to a service named `cairn`."""


def serve_parser(description: str | None) -> argparse.ArgumentParser:
    """Parser of the flags for daily use; its help also lists the settings that have no flag."""
    parser = argparse.ArgumentParser(
        "cairn serve",
        description=description,
        epilog=f"{_settings_help()}\n\n{EXIT_CODES}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        argument_default=argparse.SUPPRESS,
    )
    parser.add_argument(
        "--version", action="version", version=f"cairn {program_version()}", help="print the version, and end"
    )
    parser.add_argument("--settings", type=Path, metavar="FILE", help="TOML file of settings; see the end of this help")
    for name, (flag, metavar) in FLAGS.items():
        parser.add_argument(flag, dest=name, metavar=metavar, help=_help(Settings, name))
    for name, flag in SECRETS.items():
        text = f"file of the {_help(Settings, name)} (or ${PREFIX}{name.upper()})"
        parser.add_argument(flag, dest=f"{name}_file", type=Path, metavar="FILE", help=text)
    parser.add_argument(
        "--trust-server",
        dest="trusted_servers",
        action="append",
        metavar="KEY",
        help="public key of a server whose operators' retracts, brought by a relay, count here; may be repeated",
    )
    parser.add_argument(
        "--public-url",
        dest="public_urls",
        action="append",
        metavar="URL",
        help="URL under which robots ask this server, where its own address or certificate does not say it (behind a "
        "proxy, by a name of DNS): robots prove their keys to these names only; may be repeated",
    )
    for flag, folding, text in (
        ("--no-fold", "elsewhere", "leave it to other servers of the same --store to bring what came into the maps"),
        ("--fold-only", "only", "do nothing but that for other servers of the same --store; answer probes and metrics"),
    ):
        parser.add_argument(flag, dest="folding", action="store_const", const=folding, help=text)
    parser.add_argument("--metrics-open", action="store_true", help=_help(Settings, "metrics_open"))
    add_log_format(parser)
    parser.add_argument("-v", "--verbose", action="store_true", default=False, help="log every request and fold")
    for flag in MOVED:
        parser.add_argument(flag, action=_Moved, help=argparse.SUPPRESS)
    return parser


class _Moved(argparse.Action):
    """Refusal of a removed flag, with the line of the settings file that replaces it."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        flag = str(option)
        name, factor = MOVED[flag]
        try:
            value = f"{float(values) * factor:.15g}"
        except ValueError:
            value = "NUMBER"
        variable = PREFIX + name.upper().replace(".", BETWEEN)
        raise BadInputError(
            "bad_setting",
            f"{flag} is a setting now: write `{name} = {value}` into a file and name it with --settings FILE, "
            f"or set {variable}={value}",
        )


def settings_of(args: argparse.Namespace) -> Settings:
    """Settings of parsed flags, the environment and the settings file.

    Raises:
        BadInputError: kind `bad_setting`: a file that cannot be read, an unknown name, or a value out of its bounds;
            the message names the flag, the variable or the file.
    """
    # Flags: only those given are in `args`.
    given = {name: value for name, value in vars(args).items() if name in Settings.model_fields}
    for name in REPEATED.intersection(given):
        given[name] = " ".join(given[name])
    for name in SECRETS:
        path = getattr(args, f"{name}_file", None)
        if path is not None:
            given[name] = _text_of(path).strip()
            warn_if_open(path)
    # The file is read once, and looked at last.
    file: Path | None = getattr(args, "settings", None)
    in_file = _table_of(file) if file is not None else {}

    class Sources(Settings, BaseSettings):
        """Settings that look for their values in turn."""

        model_config = SettingsConfigDict(env_prefix=PREFIX, env_nested_delimiter=BETWEEN, env_ignore_empty=True)

        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,
            file_secret_settings: PydanticBaseSettingsSource,
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return init_settings, _Environment(settings_cls), InitSettingsSource(settings_cls, in_file)

    # Names and bounds are checked by the model, whatever source a value came from.
    try:
        return Sources(**given)
    except (SettingsError, RecursionError) as exc:
        raise BadInputError("bad_setting", f"environment: {exc}") from exc
    except ValidationError as exc:
        first = exc.errors()[0]
        names = [str(part) for part in first["loc"]]
        unknown = first["type"] == "extra_forbidden"
        message = "there is no such setting; see `cairn serve --help`" if unknown else complaint_text(first["msg"])
        raise BadInputError("bad_setting", f"{_origin(names, given, file)}: {message}") from exc


class _Environment(EnvSettingsSource):
    """Variables of the environment, without those whose names others set, too."""

    def __call__(self) -> dict[str, Any]:
        return {name: value for name, value in super().__call__().items() if name not in NOT_FROM_ENVIRONMENT}


def _origin(names: Sequence[str], given: dict[str, Any], file: Path | None) -> str:
    """Flag, variable or line of the file that a wrong value came from."""
    if names[0] in given:
        return {**{name: flag for name, (flag, _) in FLAGS.items()}, **SECRETS, **OTHER_FLAGS}[names[0]]
    for count in range(len(names), 0, -1):  # CAIRN_QUOTAS__BYTES_PER_DAY, or CAIRN_QUOTAS with an object in JSON
        variable = PREFIX + BETWEEN.join(names[:count]).upper()
        if os.environ.get(variable):
            return variable
    return f"{file}: {'.'.join(names)}"


def _table_of(file: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(_text_of(file))
    except tomllib.TOMLDecodeError as exc:
        raise BadInputError("bad_setting", f"{file} is no TOML: {exc}") from exc


def _text_of(path: Path) -> str:
    try:
        with path.open("rb") as file:  # a pipe, too: `--admin-token-file <(pass cairn)`
            data = file.read(FILE_BYTES_MAX + 1)
        text = data.decode()
    except (OSError, UnicodeDecodeError) as exc:
        raise BadInputError("bad_setting", f"cannot read {path}: {exc}") from exc
    if len(data) > FILE_BYTES_MAX:
        raise BadInputError(
            "bad_setting", f"{path} has more than {FILE_BYTES_MAX} bytes: is it the file of a secret, or of settings?"
        )
    return text


def _settings_help() -> str:
    """Paragraph of the help that lists the settings without a flag, with their defaults."""
    lines = [
        f"  {name} = {_shown(default)}\n{fill(text, WIDTH, initial_indent=' ' * 6, subsequent_indent=' ' * 6)}"
        for name, default, text in _without_flags()
    ]
    return (
        "settings without a flag, in the TOML file of --settings or in the environment; 0 for a quota is no bound:\n"
        + "\n".join(lines)
    )


def _without_flags() -> Iterator[tuple[str, Any, str]]:
    with_flags = {*FLAGS, *SECRETS, *OTHER_FLAGS}
    for name, field in Settings.model_fields.items():
        if isinstance(field.default, BaseModel):
            for inner, value in field.default:
                yield f"{name}.{inner}", value or 0, _help(type(field.default), inner, with_default=False)
        elif name not in with_flags:
            yield name, field.default, _help(Settings, name, with_default=False)


def _help(model: type[BaseModel], name: str, *, with_default: bool = True) -> str:
    """Sentence below a field, its default in brackets."""
    field = model.model_fields[name]
    text = " ".join((field.description or "").split()).rstrip(".")
    text = text if text[1:2].isupper() else text[:1].lower() + text[1:]
    shows = with_default and field.default not in (None, False, "")
    return f"{text} ({_shown(field.default)})" if shows else text


def _shown(value: Any) -> str:
    """Number as TOML has it, in groups of three digits where it is long; anything else as it is."""
    if not isinstance(value, int | float):
        return str(value)
    return f"{value:_.15g}" if value >= 10_000 else f"{value:g}"
