"""Read and write ``experiment.toml``."""

from __future__ import annotations

import json
import tomllib

from deploy import limits
from deploy.errors import UserError
from deploy.files import open_regular, replacing, reporting_os_errors
from pipeline.run.settings.schema import Settings, put


def read_settings(path) -> Settings:
    """Read ``experiment.toml``: every setting, also those that were chosen for the recordings.

    Raises
    ------
    UserError
        It cannot be read, is not TOML, or has an unknown or wrong setting.
    """
    return Settings().with_values(_read(path)[0], str(path))


def read_own_settings(path) -> Settings:
    """Read ``experiment.toml`` without what was chosen for the recordings: what the user has set.

    Raises
    ------
    UserError
        As :func:`read_settings`.
    """
    values, chosen, given = _read(path)
    settings = Settings().with_values(values, str(path))
    changes: dict = {}
    given = [*(settings.given if given is None else given)]  # a user's own file may be short
    for name, value in chosen.items():
        if settings.value(name) == value:
            put(changes, name, Settings().value(name), str(path))
        else:  # the user has edited the file
            given.append(name)
    return settings.with_values(changes, str(path)).as_given(given)


def _read(path):
    """The values in a file of settings, those that were chosen, and names of those set."""
    with reporting_os_errors(path, "cannot read", "check the path"), open_regular(path) as file:
        content = file.read(limits.SETTINGS_BYTES + 1)
    if len(content) > limits.SETTINGS_BYTES:
        raise UserError(f"{path}: larger than any file of settings; correct or delete it")
    try:
        values = tomllib.loads(content.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid TOML ({error}); correct or delete it") from error
    chosen = values.pop("chosen", {})
    given = values.pop("given", None)
    for name, kind, named in (("chosen", dict, chosen), ("given", list, given or [])):
        if not isinstance(named, kind) or not {*map(str, named)} <= Settings().flat().keys():
            raise UserError(f"{path}: {name!r} has not the names of settings; delete that line")
    return values, chosen, given


def write_settings(path, settings: Settings, own: Settings | None = None):
    """Write every setting, resolved; inverse of :func:`read_settings`.

    Parameters
    ----------
    path : path-like
    settings : Settings
    own : Settings, optional
        What the user has set; the others, which were chosen for the recordings, are also listed in
        the file.
    """
    sections, flat = settings.to_json(), settings.flat()
    before = flat if own is None else own.flat()
    chosen = [f'"{k}" = {toml_text(v)}' for k, v in flat.items() if v != before[k]]
    lines = ["# Every setting of this experiment; 'stmnist settings' lists their meanings."]
    if chosen:
        lines += ["# Chosen for the recordings, and again if these change; edit the values below:"]
        lines += [f"chosen = {{{', '.join(chosen)}}}", ""]
    given = toml_text((own or settings).given)
    lines += ["# Set by the user, and therefore never chosen:", f"given = {given}", ""]
    lines += [f"{k} = {toml_text(v)}" for k, v in sections.items() if not isinstance(v, dict)]
    for name, section in sections.items():
        if isinstance(section, dict):
            lines += ["", f"[{name}]", *(f"{k} = {toml_text(v)}" for k, v in section.items())]
    with replacing(path, "w") as file:
        file.write("\n".join(lines) + "\n")


def toml_text(value) -> str:
    """The value of a setting as TOML writes it."""
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(toml_text, value)) + "]"
    # TOML's text, numbers and booleans are JSON's, except for one character that TOML escapes.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
