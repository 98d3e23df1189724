"""Recordings by the name of their source: simulated ones, or those of a zip or folder.

The only module that knows both: :mod:`pipeline.recordings` reads files and has no simulator.
"""

from dataclasses import dataclass
from pathlib import Path

from pipeline.paper import SAMPLES_PER_DIGIT
from pipeline.progress import progress
from pipeline.recordings.cached_recordings import (
    find_cache_file,
    hash_source,
    import_recordings,
    make_reading_options,
    read_stored,
    store_and_load_recordings,
)
from pipeline.recordings.dataset import Dataset
from pipeline.recordings.files.listing import list_source
from pipeline.recordings.interpretation.options import AS_FOUND, ReadingOptions
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.sensor import GRID
from pipeline.recordings.splits import PUBLISHED, RANDOM
from pipeline.settings import SIMULATED, Settings
from pipeline.simulation.parameters import DEFAULT_POPULATION, Population, read_parameters
from pipeline.simulation.simulate import SimulationSetup, make_source, simulate_recordings


@dataclass(frozen=True)
class SimulatedSource:
    """Which simulated recordings, but for the size of the skin.

    Attributes
    ----------
    seed : int
    samples_per_digit : int
        0 for the published numbers, 6,953 in all.
    population : Population
    """

    seed: int = 0
    samples_per_digit: int = 0
    population: Population = DEFAULT_POPULATION

    @classmethod
    def from_settings(cls, settings: Settings) -> "SimulatedSource":
        """The simulated recordings that are named in the settings."""
        data = settings.data
        population = Population(
            people=data.writers,
            chunked_share=data.chunked,
            tablet_share=data.tablet,
            reversed_share=data.reversed,
            mixed_form_share=data.mixed_forms,
        )
        return cls(data.simulation_seed, data.samples_per_digit, population)

    @property
    def counts(self) -> list:
        """Number of recordings of each digit."""
        return count_samples(self.samples_per_digit)

    def make_setup(self, rows: int, columns: int) -> SimulationSetup:
        """The people and the skin.

        Parameters
        ----------
        rows, columns : int
            0 for ten.
        """
        size = (rows or GRID, columns or GRID)
        return SimulationSetup(read_parameters(self.population), size=size)


def load_recordings(
    source: str = SIMULATED,
    skip_bad: bool = False,
    jobs: int = 2,
    warn=None,
    reading: ReadingOptions = AS_FOUND,
    simulated: SimulatedSource | None = None,
) -> Recordings:
    """Recordings of a source, which are simulated or imported on first use and cached.

    Parameters
    ----------
    source : str
        ``"simulated"``, or the path of a zip or folder of recordings.
    skip_bad, jobs, warn, reading
        As in :func:`pipeline.recordings.cached_recordings.import_recordings`.  Simulated recordings
        have only the number of processes, and the rows and columns of the skin (0: ten).
    simulated : SimulatedSource, optional

    Raises
    ------
    UserError
        The source cannot be read, or the cache is damaged.
    """
    if source != SIMULATED:
        return import_recordings(Path(source), skip_bad, jobs, warn, reading)
    simulated = simulated or SimulatedSource()
    setup = simulated.make_setup(reading.rows, reading.columns)
    return load_simulated(simulated.seed, simulated.counts, jobs, setup)


def load_named_recordings(settings: Settings, jobs: int = 1, warn=None) -> Recordings:
    """Recordings named in the settings; see :func:`load_recordings`."""
    data = settings.data
    # An artifact may read only the settings that apply to its recordings (make_dataset_origin).
    if data.source == SIMULATED:
        size = ReadingOptions(settings.skin.rows, settings.skin.columns)
        simulated = SimulatedSource.from_settings(settings)
        return load_recordings(jobs=jobs, reading=size, simulated=simulated)
    reading = make_reading_options(settings)
    return load_recordings(data.source, data.skip_bad, jobs, warn, reading)


def load_dataset(settings: Settings, jobs: int = 1, warn=None) -> Dataset:
    """The recordings named in the settings, split with the seed of the settings.

    Parameters
    ----------
    settings : Settings
    jobs, warn
        As in :func:`load_recordings`.

    Raises
    ------
    UserError
        As :func:`load_recordings` and :meth:`pipeline.recordings.dataset.Dataset.from_recordings`.
    """
    return Dataset.from_recordings(settings, load_named_recordings(settings, jobs, warn))


def find_hash_and_split(settings: Settings) -> tuple:
    """The hash of the recordings named in the settings and their split, without loading them.

    Returns
    -------
    sha256 : str
        ``source.sha256`` of :func:`load_named_recordings`.
    split : str
        See :attr:`pipeline.recordings.splits.Split.kind`.

    Raises
    ------
    UserError
        The source does not exist or cannot be read.
    """
    split = settings.split.kind
    if settings.data.source == SIMULATED:
        simulated = SimulatedSource.from_settings(settings)
        setup = simulated.make_setup(settings.skin.rows, settings.skin.columns)
        sha256 = make_source(simulated.seed, simulated.counts, setup).sha256
        return sha256, RANDOM if split == "auto" else split
    listing = list_source(settings.data.source)
    if split == "auto":
        split = PUBLISHED if listing.entries[0].part else RANDOM
    return hash_source(listing), split


def count_samples(samples_per_digit: int) -> list:
    """Simulated recordings of each digit; 0 for the published numbers."""
    return [samples_per_digit] * 10 if samples_per_digit else list(SAMPLES_PER_DIGIT)


def load_simulated(
    seed: int, counts, jobs: int, setup: SimulationSetup | None = None
) -> Recordings:
    """Simulated recordings, from the cache if they are in it.

    Parameters
    ----------
    seed : int
    counts : sequence of 10 int
        Recordings of each digit.
    jobs : int
        Number of processes.
    setup : SimulationSetup, optional
    """
    path = find_path_of_simulated(make_source(seed, counts, setup).sha256)
    recordings = read_stored(path)
    if recordings is None:
        with progress("simulate", sum(counts), "recordings") as advance:
            new_recordings = simulate_recordings(seed, counts, jobs, advance, setup)
            recordings = store_and_load_recordings(path, new_recordings)
    return recordings


def find_path_of_simulated(sha256: str) -> Path:
    """The file for simulated recordings in the cache, by the hash of their source."""
    return find_cache_file("simulated", sha256)
