"""Architectures: the choice of one for a sensor, and whether the chip can hold it."""

import functools
import math
from dataclasses import replace

import numpy as np

from deploy.network.layer import Neurons
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.network.stimulus import EventFrames, ImageSpikes
from models.architecture import parse_architecture
from models.chain import build_network_spec, make_links
from pipeline.recordings.sensor import MIN_GRID_SIDE, Sensor, describe_size
from pipeline.settings import Deployment

# Rows and columns of the first convolution's output on images, at most, on average.
MAX_MAP_SIDE = 14

# Rows and columns of the first convolution's output on events, on average, as by default.
EVENT_MAP = 5

# More chips than any system has, for whether the cores are large enough.
ANY_NUMBER = 10_000


def suggest_architecture(
    sensor: Sensor, on_events: bool, hidden: int = 64, n_channels: int = 1
) -> str:
    """An architecture for a sensor and its classes, in the paper's notation.

    These are the paper's layers if they fit.  For larger sensors the first convolution has a
    stride, and for sensors with too few rows or columns for a convolution there is a hidden dense
    layer.

    Parameters
    ----------
    sensor : Sensor
    on_events : bool
        For events, with a channel for each polarity.
    hidden : int
        Neurons of the hidden layer of a network on events, or of one without convolutions.
    n_channels : int
        Channels of an image.
    """
    rows = sensor.rows
    columns = sensor.columns
    classes = len(sensor.classes)
    side = math.sqrt(rows * columns)
    smallest = min(rows, columns)
    n_channels = 2 if on_events else n_channels
    size = f"{rows}x{columns}" + (f"x{n_channels}" if n_channels > 1 else "")
    end = f"{classes}o"
    if on_events:
        stride = max(3, math.floor(side / EVENT_MAP))
        middle = [f"24c{stride + 1}s{stride}", f"{hidden}"] if smallest > stride else [f"{hidden}"]
    elif smallest < MIN_GRID_SIDE:
        middle = [f"{hidden}"]
    elif side <= MAX_MAP_SIDE + 3:
        middle = ["6c4", "24c3"]
    else:
        stride = math.ceil((side - 4) / (MAX_MAP_SIDE - 2))
        first = f"6c{stride + 2}s{stride}"
        middle = [first, "24c3"] if smallest >= stride + 2 + 2 * stride else [f"{hidden}"]
    return "-".join([size, *middle, end])


def describe_choice(section: str, architecture: str, sensor: Sensor) -> str:
    """A line about the choice of an architecture."""
    return (
        f"{architecture}: chosen for {describe_size(sensor)} and {len(sensor.classes)} classes "
        f"(another: --set {section}.architecture=...)"
    )


def is_for_sensor(architecture: str, sensor: Sensor, n_channels: int) -> bool:
    """True if an architecture has the sensor's input size and as many outputs as classes."""
    parsed = parse_architecture(architecture)
    shape = (sensor.rows, sensor.columns, n_channels)
    return parsed.input_shape == shape and parsed.outputs == len(sensor.classes)


def count_operations_of_event(architecture: str) -> float:
    """Synaptic operations of the first layer that an event causes, on average."""
    parsed = parse_architecture(architecture)
    return float(np.mean(parsed.layers[0].count_fan_out(parsed.input_shape)))


@functools.lru_cache(maxsize=8)
def plan_untrained(architecture: str, on_events: bool, deployment: Deployment):
    """The plan of an untrained network on any number of chips.

    The arguments are those of :func:`list_chip_problems`.

    The resources that a network needs do not depend on the values of its weights.

    Returns
    -------
    deploy.preflight.plan.Plan
    """
    from deploy.preflight.plan import make_plan  # imports NengoLoihi, which takes seconds

    return make_plan(make_untrained_network(architecture, on_events, deployment), ANY_NUMBER)


def list_chip_problems(architecture: str, on_events: bool, deployment: Deployment) -> tuple:
    """Reasons why a network of an architecture does not fit the cores of the chip.

    Parameters
    ----------
    architecture : str
    on_events : bool
        Whether its input is events, not images.
    deployment : pipeline.settings.groups.Deployment

    Returns
    -------
    tuple of str
        One line for each layer and limit, with the excess and a remedy.
    """
    plan = plan_untrained(architecture, on_events, deployment)
    return tuple(f"{architecture}: {problem}" for problem in plan.problems)


def make_untrained_network(text: str, on_events: bool, deployment: Deployment) -> NetworkSpec:
    """A network with random weights.

    Parameters
    ----------
    text : str
        The architecture in its notation.
    on_events : bool
        Whether its input is events, not images.
    deployment : pipeline.settings.groups.Deployment
    """
    rng = np.random.default_rng(0)
    links = make_links(parse_architecture(text))
    on_host = on_events or deployment.readout == "host"
    chain = [
        replace(
            link,
            kernel=rng.uniform(0.5, 1.0, link.kernel.shape),
            neurons=None if on_host and link is links[-1] else Neurons(0.01),
            synapse=deployment.synapse_s or None,
        )
        for link in links
    ]
    stimulus = EventFrames() if on_events else ImageSpikes()
    return build_network_spec(tuple(chain), stimulus, Presentation())


def suggest_sensor_size(network_size: tuple, sensor_size: tuple) -> str:
    """The settings that fit recordings to an imported network for a larger sensor, or nothing.

    The size of a sensor that is read from files is that of its largest coordinates, and the outer
    taxels may have no events.

    Parameters
    ----------
    network_size, sensor_size : (int, int)
        Rows and columns of the network's input, and of the recordings.
    """
    if network_size == sensor_size or any(
        n < f for n, f in zip(network_size, sensor_size, strict=True)
    ):
        return ""
    rows, columns = network_size
    return (
        "if the sensor's outer taxels have no events, give its size, "
        f"--set skin.rows={rows} --set skin.columns={columns}; else "
    )
