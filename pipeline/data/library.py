"""Loading recordings by the name of their source: simulated or imported, and cached."""

from __future__ import annotations

from dataclasses import astuple, replace
from pathlib import Path

from pipeline.data import archive, cache
from pipeline.data.events import GRID, Recordings
from pipeline.data.sensors import AS_FOUND, Reading
from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.progress import progress
from pipeline.settings import SIMULATED, Settings
from pipeline.skin.simulate import simulate, source_of


def load_recordings(
    source: str = SIMULATED,
    simulation_seed: int = 0,
    samples_per_digit: int = 0,
    skip_bad: bool = False,
    jobs: int = 2,
    warn=None,
    reading: Reading = AS_FOUND,
    traces=None,
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
    reading : pipeline.data.sensors.Reading
        Rows and columns of the skin (0: ten for the simulated skin), and options for reading files.
    traces : sequence of pipeline.skin.handwriting.Trace, optional
        Recorded handwriting to press on the simulated skin instead of simulated writers.

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
        return simulated(simulation_seed, counts, jobs, traces=traces, size=size)
    return _imported(Path(source), skip_bad, jobs, warn, reading)


def recordings_of(settings: Settings, jobs: int = 1, warn=None) -> Recordings:
    """Recordings named in the settings; see :func:`load_recordings`."""
    data, reading = settings.data, Reading(settings.skin.rows, settings.skin.columns)
    # An artifact may read only the settings that apply to its recordings (dataset_origin).
    if data.source == SIMULATED:
        return load_recordings(
            SIMULATED, data.simulation_seed, data.samples_per_digit, jobs=jobs, reading=reading
        )
    reading = replace(reading, time_unit=data.time_unit, downsample=data.downsample)
    return load_recordings(
        data.source, skip_bad=data.skip_bad, jobs=jobs, warn=warn, reading=reading
    )


def content_of(settings: Settings) -> str:
    """The hash of the recordings named in the settings, without loading them.

    Returns
    -------
    str
        ``source.sha256`` of :func:`recordings_of`.

    Raises
    ------
    UserError
        The source does not exist or cannot be read.
    """
    data, skin = settings.data, settings.skin
    if data.source == SIMULATED:
        size = (skin.rows or GRID, skin.columns or GRID)
        counts = _counts(data.samples_per_digit)
        return source_of(data.simulation_seed, counts, size=size).sha256
    archive.list_source(data.source)
    return _hash_of(Path(data.source))


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
        ``parameters``, ``traces`` and ``size`` of :func:`pipeline.skin.simulate.simulate`.
    """
    key = cache.key_of("simulated", source_of(seed, counts, **how).sha256)
    recordings = cache.load(key)
    if recordings is None:
        with progress("simulate", sum(counts)) as advance:
            recordings = simulate(seed, counts, jobs, advance, **how)
        cache.store(key, recordings)
    return recordings


def _imported(path, skip_bad, jobs, warn, reading):
    listing = archive.list_source(path)  # reports a wrong path or damaged zip before the hash
    sha256 = _hash_of(path)
    # An import without the bad files must not be used as a complete import later.
    key = ["imported", path.name, sha256, skip_bad, *astuple(reading)]
    if left_out := (*listing.refused, *listing.noted):  # such as empty folders, not in the hash
        key += map(list, left_out)
    key = cache.key_of(*key)
    recordings = cache.load(key)
    if recordings is None:
        recordings = archive.read_source(path, jobs, skip_bad, progress, reading)
        cache.store(key, recordings)
    if warn is not None:
        for line in archive.left_out_lines(path, recordings):
            warn(line)
    return recordings


def _hash_of(path):
    """The content hash of a source, which is read again only if its files have changed."""
    fingerprint = archive.fingerprint(path)
    sha256 = cache.recall(fingerprint)
    if sha256 is None:
        sha256 = archive.content_hash(path)
        cache.remember(fingerprint, sha256)
    return sha256
