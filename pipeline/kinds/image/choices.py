"""Settings of a network on images that are chosen for the recordings.

The rules were cross-validated within training sets only: those of ST-MNIST, of two published data
sets of real touch with 39 and 80 taxels in a strip, and of the simulation.
"""

import math
from dataclasses import dataclass, replace

from deploy.errors import UserError
from deploy.tables import format_count
from models.architecture import parse_architecture
from pipeline.kinds.architectures import describe_choice, is_for_sensor, suggest_architecture
from pipeline.kinds.presentation import choose_image_gap
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.sensor import MIN_GRID_SIDE, Sensor, are_digits
from pipeline.settings import Choice, Settings, list_names_in
from pipeline.training.images.schedules import SCHEDULES

# Passes over the training samples of a network on one image of recordings that are not simulated.
# On ST-MNIST the default of 60 has two points less, with faulty taxels three.  Fewer recordings
# than the minimum have as many passes by their schedule.
EPOCHS_ON_REAL_IMAGES = 200
MIN_RECORDINGS_FOR_EPOCHS = 2000

# Inputs of a neuron up to which a network is trained from a CNN's weights at the learning rate of
# the schedule.  The change of a neuron's sum in an update grows with its inputs: with 9,216 of them
# this rate left Keras's example for MNIST at chance, and a rate in proportion did not.
MAX_INPUTS_AT_FULL_RATE = 500

# Rows and columns of the first convolution's output on slices of time, on average.
SLICES_MAP = 5


@dataclass(frozen=True)
class SliceDefaults:
    """The defaults of a network on several slices of time, for a kind of sensor.

    Attributes
    ----------
    slices : int
        Slices of time, each with a channel for either polarity.
    hidden : int
        Neurons of its hidden dense layer.
    dropout : float
        Share of the neurons that are left out in training.
    input_rate : float
        Spikes per second of its largest pixel.
    """

    slices: int
    hidden: int
    dropout: float
    input_rate: float


# For a grid of taxels, with a convolution before the hidden layer. Its stride of 2 makes it three
# times as cheap as convolutions like those of the CNN, and more accurate.
GRID_DEFAULTS = SliceDefaults(slices=8, hidden=128, dropout=0.1, input_rate=60.0)

# For a sensor that is too small for convolutions: as accurate with 60 input spikes per second as
# with 500, for an eighth of the operations.
STRIP_DEFAULTS = SliceDefaults(slices=8, hidden=256, dropout=0.5, input_rate=60.0)


def choose_image_augmentation(recordings: Recordings) -> str:
    """The augmentation in training with rate-LIF neurons, where ``cnn.augment`` is ``auto``.

    Returns
    -------
    str
        ``slight`` for digits on a grid, which are handwriting, and ``time`` for other recordings: a
        place on another sensor may have a meaning of its own.
    """
    sensor = recordings.sensor
    return "slight" if sensor.is_grid and are_digits(sensor.classes) else "time"


def choose_image_settings(settings: Settings, recordings: Recordings) -> list[Choice]:
    """Choose settings of a network on images that the user has not set.

    Parameters
    ----------
    settings : Settings
        What the user has set.
    recordings : Recordings

    Raises
    ------
    UserError
        The user's other settings do not fit what is chosen.
    """
    sensor = recordings.sensor
    cnn = settings.cnn
    is_strip = not sensor.is_grid
    defaults = STRIP_DEFAULTS if is_strip else GRID_DEFAULTS
    is_own = bool(cnn.model) or not settings.is_open("cnn.architecture")
    own_channels = parse_architecture(cnn.architecture).input_shape[2] if is_own else None
    is_sliced = settings.input.kind == "slices" or (
        # One image of a strip has hardly any shapes, so that time is needed to tell classes apart.
        is_strip
        and all(map(settings.is_open, list_names_in("image")))
        and own_channels in (None, 2 * defaults.slices)
    )
    choices = _choose_normalisation(settings)
    channels = settings.image.channels
    gap, reason = choose_image_gap(settings)
    if gap is not None:
        choices.append(Choice("presentation.gap", gap, reason))
    if is_sliced:
        slices = _choose_slices(settings, defaults, own_channels)
        of_image, channels = _choose_image(settings, slices, recordings.table)
        choices += of_image + _choose_training(settings, defaults)
    else:
        choices += _choose_epochs(settings, recordings)
    choices += _choose_learning_rate(settings)
    if is_own or (not is_sliced and is_for_sensor(cnn.architecture, sensor, channels)):
        return choices
    if is_sliced:
        architecture = _make_architecture_of_slices(sensor, defaults, channels)
    else:
        architecture = suggest_architecture(sensor, False, defaults.hidden, channels)
    _require_rates_fit(settings, architecture)
    chosen = describe_choice("cnn", architecture, sensor)
    return [Choice("cnn.architecture", architecture, chosen), *choices]


def _choose_normalisation(settings):
    """The normalisation of images, unless the network was trained elsewhere."""
    if settings.cnn.model or not settings.is_open("image.normalisation"):
        return []
    reason = (
        "image of the square roots of counts, on which one hot taxel has no effect (counts divided "
        "by the largest, as the paper may have done: --set image.normalisation=max)"
    )
    return [Choice("image.normalisation", "sqrt-clip", reason)]


def _choose_epochs(settings, recordings):
    """More passes than the default, for real recordings that are presented as one image."""
    is_trained_here = settings.snn.recipe == "loihi" and not settings.cnn.model
    is_real = not recordings.source.simulated
    is_large = len(recordings) >= MIN_RECORDINGS_FOR_EPOCHS
    if not (is_trained_here and is_real and is_large and settings.is_open("snn.epochs")):
        return []
    reason = f"{EPOCHS_ON_REAL_IMAGES} epochs of rate-lif (another: --set snn.epochs=...)"
    return [Choice("snn.epochs", EPOCHS_ON_REAL_IMAGES, reason)]


def _choose_learning_rate(settings):
    """A lower learning rate for a user's model some of whose neurons have many inputs."""
    is_trained_further = bool(settings.cnn.model) and settings.snn.recipe == "loihi"
    if not is_trained_further or not settings.is_open("snn.learning_rate"):
        return []
    shapes = parse_architecture(settings.cnn.architecture).weight_shapes
    kernels = [shape for name, shape in shapes.items() if name.endswith(".kernel")]
    inputs = max(math.prod(shape[:-1]) for shape in kernels)
    if inputs <= MAX_INPUTS_AT_FULL_RATE:
        return []
    full_rate = SCHEDULES["loihi"].learning_rate
    rate = float(f"{full_rate * MAX_INPUTS_AT_FULL_RATE / inputs:.1g}")
    reason = (
        f"learning rate of rate-lif {rate:g}, since a neuron has up to {inputs} inputs (another: "
        "--set snn.learning_rate=...)"
    )
    return [Choice("snn.learning_rate", rate, reason)]


def _choose_slices(settings, defaults, own_channels):
    """The number of slices: the user's, that of the user's network, or the default."""
    if not settings.is_open("image.slices"):
        return settings.image.slices
    if own_channels is not None and own_channels % 2 == 0:
        return own_channels // 2
    return defaults.slices


def _choose_image(settings, slices, table):
    """The choices of a sliced image, and its number of channels."""
    duration_ms = float(math.ceil(table.typical_duration_ms))
    values = {"aggregation": "polarities", "slices": slices, "duration": duration_ms}
    open_values = {
        name: value for name, value in values.items() if settings.is_open(f"image.{name}")
    }
    image = settings.with_values({"image": open_values}).image
    if not open_values:
        return [], image.channels
    content = "ON and OFF events" if image.aggregation == "polarities" else image.aggregation
    reason = (
        f"{image.channels} channels: {content} in {image.slices} slices of "
        f"{image.duration_ms / image.slices:.0f} ms (another image: --set image.slices=... and "
        "others)"
    )
    first, *others = (Choice(f"image.{name}", value) for name, value in open_values.items())
    return [replace(first, reason=reason), *others], image.channels


def _choose_training(settings, defaults):
    """The dropout of a network that is trained here, and the rate of its input."""
    choices = []
    if not settings.cnn.model and settings.is_open("snn.dropout"):
        reason = f"dropout {defaults.dropout:g} (another: --set snn.dropout=...)"
        choices.append(Choice("snn.dropout", defaults.dropout, reason))
    if settings.is_open("deployment.input_rate"):
        reason = (
            f"at most {defaults.input_rate:g} input spikes per second of a pixel (another: --set "
            "deployment.input_rate=...)"
        )
        choices.append(Choice("deployment.input_rate", defaults.input_rate, reason))
    return choices


def _make_architecture_of_slices(sensor: Sensor, defaults: SliceDefaults, n_channels: int) -> str:
    """A convolution with a stride, then a dense layer; on a strip only the latter."""
    rows = sensor.rows
    columns = sensor.columns
    stride = max(2, math.floor(math.sqrt(rows * columns) / SLICES_MAP))
    layers = [f"{rows}x{columns}x{n_channels}"]
    if min(rows, columns) >= max(MIN_GRID_SIDE, stride + 2):
        layers.append(f"32c{stride + 2}s{stride}")
    return "-".join([*layers, f"{defaults.hidden}", f"{len(sensor.classes)}o"])


def _require_rates_fit(settings, architecture):
    """Refuse rates of the user for more layers of neurons than the chosen network has."""
    rates = settings.snn.max_rates
    layers = len(parse_architecture(architecture).spiking)
    if len(rates) > layers:
        raise UserError(
            f"'snn.max_rates' has {len(rates)} rates, and {architecture}, chosen for the "
            f"recordings, has {format_count(layers, 'layer')} of neurons; give as many "
            "rates or one, or choose cnn.architecture"
        )
