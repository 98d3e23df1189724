"""Keras's pooling: averages, and maxima that a further training replaces by averages."""

from models.keras.converter import RETRAIN, LayerConverter, WindowMeans
from models.keras.model import KerasLayer
from models.keras.signal import compute_counts
from models.ops import Pooling


def convert_pooling(converter: LayerConverter, layer: KerasLayer):
    """Average over windows, also in place of a maximum; global pooling has one window."""
    is_maximum = "Max" in layer.kind
    if is_maximum and not converter.retrain:
        layer.refuse(
            f"the chip cannot take a maximum; {RETRAIN} an average and the network is trained "
            "further; or use AveragePooling2D, or a stride in the convolution before it"
        )
    if is_maximum and converter.is_linear:
        converter.deferred = layer
        return
    sides = converter.signal.shape[:2]
    is_global = layer.kind.startswith("Global")
    size = sides if is_global else layer.read_pair("pool_size")
    has_strides = not is_global and layer.config["strides"] is not None
    strides = layer.read_pair("strides") if has_strides else size
    padding = layer.config.get("padding", "valid")
    if is_maximum:
        # Windows without overlap, if there are as many, are those of the chip.
        counts = compute_counts(sides, size, strides, padding)
        text = " over the same windows"
        if strides[0] == strides[1] > 1 and counts == [n // strides[0] for n in sides]:
            size, padding, text = strides, "valid", f"({strides[0]})"
        converter.replaced.append(f"{layer}: replaced by AveragePooling2D{text}")
    _pool_average(converter, size, strides, padding)
    if is_global and not layer.config.get("keepdims", False):
        converter.signal.flatten()


def _pool_average(converter, size, strides, padding):
    """Append a pooling, or let the signal have averages that the chip's pooling does not have."""
    affine = None
    if not (converter.is_linear or converter.signal.is_padded):
        affine = converter.signal.find_channel_affine()
    sides = converter.signal.shape[:2]
    fills = padding == "valid" or not any(n % k for n, k in zip(sides, size, strict=True))
    if affine is not None and size == strides and size[0] == size[1] and fills:
        if size != (1, 1):
            converter.layers.append(Pooling(size[0]))
            shape = converter.layers[-1].compute_shape(converter.signal.built)
            converter.signal.begin(shape, *affine)
        return
    converter.signal.average(size, strides, padding)
    if affine is not None and padding == "valid":
        converter.means = WindowMeans(size, strides, affine, converter.signal.map)
