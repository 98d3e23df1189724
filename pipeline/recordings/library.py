"""Loading recordings by the name of their source: simulated or imported on first use, and cached.

The cache has some files for each set of recordings, which are keyed by the source's content.  The
columns of its events are files of their own, which are memory-mapped: what is used of them is read.
"""

import hashlib
import json
import re
from dataclasses import astuple
from pathlib import Path

import numpy as np

from deploy.errors import UserError
from deploy.files import read_arrays, read_json, write_arrays, write_json
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.progress import progress
from pipeline.recordings import source as sources
from pipeline.recordings.cache import cache_folder, map_column, write_column
from pipeline.recordings.events import (
    EVENT_DTYPES,
    GRID,
    Events,
    Recordings,
    Sensor,
    Source,
    TaxelMap,
)
from pipeline.recordings.sensor import AS_FOUND, ReadingOptions
from pipeline.recordings.splits import PUBLISHED, RANDOM
from pipeline.run.settings import SIMULATED, Settings
from pipeline.simulation import parameters
from pipeline.simulation.simulate import simulate, source_of

# Version of the cache; increase it with any change of the stored data or of the reading.
FORMAT = 8

# Maximum number of bytes of a set of recordings, a hundred times that of the published one.
LARGEST_CACHE = 1 << 34

DELETE = "delete it and run the command again to make it again"


def load_recordings(  # noqa: PLR0913 - all have defaults; callers name them
    source: str = SIMULATED,
    simulation_seed: int = 0,
    samples_per_digit: int = 0,
    skip_bad: bool = False,
    jobs: int = 2,
    warn=None,
    reading: ReadingOptions = AS_FOUND,
    writers: int = parameters.PEOPLE,
    chunked: float = 0.0,
) -> Recordings:
    """Recordings of a source, which are simulated or imported on first use and cached.

    Parameters
    ----------
    source : str
        ``"simulated"``, or the path of a zip or folder of recordings.
    simulation_seed : int
        Seed of simulated recordings.
    samples_per_digit : int
        Number of simulated recordings; 0 for the published numbers, 6,953 in all.
    skip_bad : bool
        True to leave out files that cannot be read instead of stopping.
    jobs : int
        Processes.
    warn : callable, optional
        Called with one line for each file that was left out.
    reading : pipeline.recordings.sensor.ReadingOptions
        Rows and columns of the skin (0: ten for the simulated skin), and options for reading files.
    writers : int
        Number of simulated people.
    chunked : float
        Share of the simulated recordings that keep the order of events and not their time.

    Returns
    -------
    Recordings

    Raises
    ------
    UserError
        The source cannot be read, or the cache is damaged.
    """
    if source == SIMULATED:
        size = (reading.rows or GRID, reading.columns or GRID)
        counts = _counts(samples_per_digit)
        people = parameters.load(writers, chunked)
        return simulated(simulation_seed, counts, jobs, size=size, parameters=people)
    return _imported(Path(source), skip_bad, jobs, warn, reading)


def recordings_of(settings: Settings, jobs: int = 1, warn=None) -> Recordings:
    """Recordings named in the settings; see :func:`load_recordings`."""
    data = settings.data
    # An artifact may read only the settings that apply to its recordings (dataset_origin).
    if data.source == SIMULATED:
        return load_recordings(
            SIMULATED,
            data.simulation_seed,
            data.samples_per_digit,
            jobs=jobs,
            reading=ReadingOptions(settings.skin.rows, settings.skin.columns),
            writers=data.writers,
            chunked=data.chunked,
        )
    reading = options_from(settings)
    return load_recordings(
        data.source, skip_bad=data.skip_bad, jobs=jobs, warn=warn, reading=reading
    )


def options_from(settings: Settings) -> ReadingOptions:
    """The settings of reading files."""
    data = settings.data
    return ReadingOptions(
        settings.skin.rows,
        settings.skin.columns,
        time_unit=data.time_unit,
        downsample=data.downsample,
        bin_ms=data.bin,
        rise=data.rise,
    )


def identity_of(settings: Settings) -> tuple:
    """The hash of the recordings named in the settings and their split, without loading them.

    Returns
    -------
    sha256 : str
        ``source.sha256`` of :func:`recordings_of`.
    kind : str
        Kind of the split, see :class:`pipeline.recordings.splits.Split`.

    Raises
    ------
    UserError
        The source does not exist or cannot be read.
    """
    data = settings.data
    skin = settings.skin
    kind = settings.split.kind
    if data.source == SIMULATED:
        size = (skin.rows or GRID, skin.columns or GRID)
        counts = _counts(data.samples_per_digit)
        people = parameters.load(data.writers, data.chunked)
        sha256 = source_of(data.simulation_seed, counts, people, size=size).sha256
        return sha256, RANDOM if kind == "auto" else kind
    listing = sources.list_source(data.source)
    if kind == "auto":
        kind = PUBLISHED if listing.entries[0].part else RANDOM
    return _hash_of(listing), kind


def _counts(samples_per_digit):
    return [samples_per_digit] * 10 if samples_per_digit else list(SAMPLES_PER_DIGIT)


def simulated(seed: int, counts, jobs: int, **how) -> Recordings:
    """Simulated recordings, from the cache if they are in it.

    Parameters
    ----------
    seed : int
    counts : sequence of 10 int
        Recordings of each digit.
    jobs : int
        Processes.
    **how
        ``parameters``, ``traces`` and ``size`` of :func:`pipeline.simulation.simulate.simulate`.
    """
    path = path_of_simulated(source_of(seed, counts, **how).sha256)
    recordings = load(path)
    if recordings is None:
        with progress("simulate", sum(counts)) as advance:
            store(path, simulate(seed, counts, jobs, advance, **how))
        recordings = _load_stored(path)
    return recordings


def _imported(source, skip_bad, jobs, warn, reading):
    listing = sources.list_source(source)
    # An import without the bad files must not be used as a complete import later, and refused
    # files are not in the hash.
    refused = [list(entry) for entry in listing.refused]
    how = (skip_bad, *astuple(reading), refused)
    path = _path("imported", source.name, _hash_of(listing), *how)
    recordings = load(path)
    if recordings is None:
        store(path, sources.read_source(source, jobs, skip_bad, progress, reading))
        recordings = _load_stored(path)
    if warn is not None:
        for line in sources.reading_lines(source, recordings):
            warn(line)
    return recordings


def _hash_of(listing):
    """The content hash of a source, which is read again only if its files have changed."""
    path = cache_folder() / f"source-{sources.fingerprint(listing)[:24]}.json"
    if path.exists():
        sha256 = read_json(path, DELETE).get("sha256")
        if isinstance(sha256, str) and re.fullmatch("[0-9a-f]{64}", sha256):
            return sha256
    sha256 = sources.content_hash(listing)
    write_json(path, {"sha256": sha256})
    return sha256


def _path(*key):
    """The file for recordings that are determined by some plain values."""
    name = hashlib.sha256(json.dumps([FORMAT, *key]).encode()).hexdigest()[:24]
    return cache_folder() / f"recordings-{name}.npz"


def _column_path(path, name):
    """The file of a column of the events of recordings."""
    return path.with_name(f"{path.stem}-{name}.npy")


def path_of_simulated(sha256: str) -> Path:
    """The file for simulated recordings, by the hash of their source."""
    return _path("simulated", sha256)


def store(path, recordings: Recordings):
    """Save recordings; the file at ``path`` is written last, since it marks them as complete."""
    for name in EVENT_DTYPES:
        write_column(_column_path(path, name), getattr(recordings.events, name))
    source, sensor, taxels = recordings.source, recordings.sensor, recordings.taxels
    positions = np.empty((0, 2)) if taxels.positions is None else taxels.positions
    write_arrays(
        path,
        compress=False,  # loads faster than compressed arrays
        offsets=recordings.offsets,
        labels=recordings.labels,
        ids=np.array(recordings.ids, dtype=str),
        writers=recordings.writers,
        parts=np.array(recordings.parts, dtype=str),
        row=taxels.row,
        column=taxels.column,
        positions=positions,
        source=np.array([source.name, source.sha256, source.time_unit]),
        bins=np.array([source.bin_ms, source.rise]),
        remarks=np.array(source.remarks, dtype=str),
        simulated=np.array(source.simulated),
        written=np.array(source.written),
        left_out=np.array(source.left_out, dtype=str),
        size=np.array([sensor.rows, sensor.columns, sensor.polarities]),
        duration_s=np.array(sensor.duration_s),
        classes=np.array(sensor.classes, dtype=str),
    )


def _load_stored(path) -> Recordings:
    """Recordings that were stored just now: from the files, so that they do not take memory."""
    recordings = load(path)
    assert recordings is not None
    return recordings


def load(path) -> Recordings | None:
    """Load recordings, or return None if the file does not exist.

    Raises
    ------
    UserError
        The file exists but is damaged.
    """
    if not path.exists():
        return None
    arrays = read_arrays(path, DELETE, LARGEST_CACHE)
    of_events = [
        map_column(_column_path(path, name), dtype, DELETE) for name, dtype in EVENT_DTYPES.items()
    ]
    try:
        if {len(column) for column in of_events} != {int(arrays["offsets"][-1])}:
            raise ValueError("another number of events")
        name, sha256, time_unit = (str(text) for text in arrays["source"])
        bin_ms, rise = arrays["bins"].tolist()
        positions = arrays["positions"]
        rows, columns, polarities = arrays["size"]
        recordings = Recordings(
            events=Events(*of_events),
            offsets=arrays["offsets"],
            labels=arrays["labels"],
            ids=tuple(arrays["ids"].tolist()),
            writers=arrays["writers"],
            source=Source(
                name,
                sha256,
                simulated=bool(arrays["simulated"]),
                written=bool(arrays["written"]),
                left_out=tuple(arrays["left_out"].tolist()),
                time_unit=time_unit,
                bin_ms=bin_ms,
                rise=int(rise),
                remarks=tuple(arrays["remarks"].tolist()),
            ),
            taxels=TaxelMap(arrays["row"], arrays["column"], positions if len(positions) else None),
            sensor=Sensor(
                rows=int(rows),
                columns=int(columns),
                polarities=int(polarities),
                duration_s=float(arrays["duration_s"]),
                classes=tuple(arrays["classes"].tolist()),
            ),
            parts=tuple(arrays["parts"].tolist()),
        )
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise UserError(f"{path}: damaged cache ({error}); {DELETE}") from error
    return recordings
