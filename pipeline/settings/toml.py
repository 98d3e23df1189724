"""Read and write ``experiment.toml``."""

from __future__ import annotations

import json
import tomllib

from deploy import limits
from deploy.errors import UserError
from deploy.files import open_regular, replacing, reporting_os_errors
from pipeline.settings.choices import Provenance
from pipeline.settings.schema import Settings


def read_settings(path) -> Settings:
    """Read ``experiment.toml``: every setting, with its provenance.

    A value is chosen if the file lists it as chosen and the user has not edited it since; it is
    the user's if the file lists it as given or it is not the default.  In a file without these
    lists, such as one that the user has written, all values are the user's.

    Raises
    ------
    UserError
        It cannot be read, is not TOML, or has an unknown or wrong setting.
    """
    values, chosen, set_by_user = _read(path)
    settings = Settings().with_values(values, str(path))
    if set_by_user is None:
        set_by_user = [] if chosen else settings.list_names(Provenance.USER)
    provenance = dict.fromkeys(set_by_user, Provenance.USER)
    for name, value in chosen.items():
        is_edited = _replace_list(value) != _replace_list(settings.get_value(name))
        provenance[name] = Provenance.USER if is_edited else Provenance.CHOSEN
    return settings.with_provenance(provenance)


def read_own_settings(path) -> Settings:
    """Read ``experiment.toml`` without what was chosen for the recordings: what the user has set.

    Raises
    ------
    UserError
        As :func:`read_settings`.
    """
    return read_settings(path).without_choices()


def _replace_list(value):
    """A value with a tuple in the place of a list, as TOML has it."""
    return tuple(value) if isinstance(value, list) else value


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
    set_by_user = values.pop("given", None)
    for name, kind, named in (("chosen", dict, chosen), ("given", list, set_by_user or [])):
        if not isinstance(named, kind) or not {*map(str, named)} <= Settings().flatten().keys():
            raise UserError(
                f"{path}: {name!r} lists something that is not a setting; delete that line"
            )
    return values, chosen, set_by_user


def write_settings(path, settings: Settings):
    """Write every setting, resolved, with its provenance; inverse of :func:`read_settings`.

    Parameters
    ----------
    path : path-like
    settings : Settings
    """
    sections = settings.to_json()
    names = settings.list_names(Provenance.CHOSEN)
    chosen = [f'"{name}" = {format_toml(settings.get_value(name))}' for name in names]
    set_by_user = format_toml(settings.list_names(Provenance.USER))
    lines = ["# Every setting of this experiment; 'stmnist settings' lists their meanings."]
    if chosen:
        lines += ["# Chosen for the recordings, and again if these change; edit the values below:"]
        lines += [f"chosen = {{{', '.join(chosen)}}}", ""]
    lines += ["# Set by the user, and therefore never chosen:", f"given = {set_by_user}", ""]
    lines += [f"{k} = {format_toml(v)}" for k, v in sections.items() if not isinstance(v, dict)]
    for name, section in sections.items():
        if isinstance(section, dict):
            lines += ["", f"[{name}]", *(f"{k} = {format_toml(v)}" for k, v in section.items())]
    with replacing(path, "w") as file:
        file.write("\n".join(lines) + "\n")


def format_toml(value) -> str:
    """The value of a setting as TOML writes it."""
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(format_toml, value)) + "]"
    # TOML's text, numbers and booleans are JSON's, except for one character that TOML escapes.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
