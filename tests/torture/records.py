"""The records of a finished run, damaged, and the commands that look at a run as it is."""

import json
import shutil

from deploy.files import read_json

from . import damage


def record(rng, folder, base):
    """A run in which one of the JSON files says something else, or is none."""
    run = folder / "run"
    shutil.copytree(base.run, run)
    (folder / "cache").symlink_to(base.run.parent / "cache")
    paths = sorted(path for path in run.rglob("*.json") if path.parent.name != "bundle")
    path = paths[int(rng.integers(0, len(paths)))]
    value, way = read_json(path, ""), rng.random()
    if way < 0.1:
        path.write_bytes(damage.huge_json(rng))
    elif way < 0.45 and "made_from" in value:
        value["made_from"] = json.loads(_json(rng, value["made_from"]))
        path.write_text(json.dumps(value))
    elif way < 0.6:  # one that matters, near the top
        name = sorted(value)[int(rng.integers(0, len(value)))]
        value[name] = damage.pick(rng, damage.NUMBERS + damage.OTHERS)
        path.write_text(json.dumps(value))
    elif way < 0.65:
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes(damage.json_text(rng, value))
    verbs = [
        ["status", run], ["status", run], ["status", run, "--json"], ["report", run],
        ["compare", run, base.run], ["compare", base.run, run, "--json"],
        ["check", "run", run, "--target", "fast", "--out", folder / "fast.json"],
    ]  # fmt: skip
    if path.name == "ladder.json":  # of others, networks would be trained again
        verbs.append(["ladder", run, "--jobs", 1])
    return verbs[int(rng.integers(0, len(verbs)))]


def _json(rng, value):
    return json.dumps(damage.value(rng, value))
