"""An animation of a sample of a check: touch, spikes of the layers and probabilities over time."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from deploy.check.bundle import Bundle
from deploy.files import replacing, require_ending
from deploy.network.provenance import read_classes, read_positions
from deploy.tables import shorten_name
from pipeline.look import find_colour
from pipeline.results.report.figures import SHADES
from pipeline.results.report.samples import replay_samples

# Number of frames, and the duration of each and of the last one in milliseconds.
FRAMES = 48
FRAME_MS = 60
LAST_MS = 3000

# Characters of a class's name beside a curve, and as the prediction.
MAX_NAME_LENGTH = 32
MAX_PREDICTION_LENGTH = 16

LEGEND = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "frameon": False, "fontsize": 9}

NAMES = {"on": "ON: rises", "off": "OFF: falls"}
# Of the curves, for those who do not see their colours.
STYLES = ("-", "--", ":", "-.")
# Probability below which a prediction is not shown: it would only flicker.
MIN_SHOWN = 0.4


def animate(path, bundle: Bundle, index: int, advance=None):
    """Write the animation of a sample of a bundle's check.

    The input, the spikes of every layer and the probabilities are on one time axis, that of the
    presentation.  Events fill the picture of the sensor while they arrive; an image is complete
    before it is presented.

    Parameters
    ----------
    path : Path
        Ends in .gif.
    bundle : Bundle
    index : int
        Index of the sample in the check.
    advance : callable, optional
        Called after each frame.

    Raises
    ------
    UserError
        Another ending of the name, or the file cannot be written.
    """
    require_ending(path, ".gif")
    animation = _Animation(bundle, index)
    frames = []
    for now_ms in np.linspace(0, animation.extent_ms, FRAMES):
        frames.append(animation.draw(now_ms))
        if advance is not None:
            advance()
    # The result is first, too: some programs show the first frame only.
    timing = {"duration": [FRAME_MS] * FRAMES + [LAST_MS], "loop": 0}
    with replacing(path) as file:
        frames[-1].save(file, "gif", save_all=True, append_images=frames, **timing)


class _Animation:
    """The figure of an animation; :meth:`draw` sets it to a moment.

    On the left are the sensor and the prediction; on the right, on one time axis, the spikes of
    each layer and the probabilities.
    """

    def __init__(self, bundle, index):
        spec = bundle.spec
        self._spec = spec
        self._played = replay_samples(bundle, [index], bundle.seed)[index]
        self._label = int(bundle.checks.labels[index])
        self._classes = read_classes(spec)
        self._names = [shorten_name(name, MAX_PREDICTION_LENGTH) for name in self._classes]
        self._measure = "probability" if spec.estimator else "softmax"
        self._step_ms = 1000 * spec.stimulus.step_seconds
        self.extent_ms = self._step_ms * spec.presentation.steps
        first = spec.presentation.readout_start + 1
        self._times_ms = self._step_ms * (first + np.arange(len(self._played.probabilities)))
        self._decided_ms = self._times_ms[self._played.decided]
        self._growing = _accumulate_events(bundle.checks.inputs[index])
        sensor_axes, panels = self._make_figure(bundle.checks.ids[index])
        self._draw_touch = self._add_sensor(sensor_axes[0])
        self._add_prediction(sensor_axes[1])
        self._add_clocks(panels)
        self._marks = self._add_spikes(panels)
        self._curves = self._add_probabilities(panels[-1])
        self._canvas = FigureCanvasAgg(self._figure)
        self._canvas.draw()
        self._figure.set_layout_engine("none")  # of the first frame, for all

    def draw(self, now_ms) -> Image.Image:
        """The picture at a time of the presentation."""
        step = min(int(now_ms / self._step_ms), len(self._growing) - 1)
        is_there = now_ms > 0 or len(self._growing) == 1
        self._draw_touch(self._growing[step] * is_there)
        for clock in self._clocks:
            clock.set_xdata([now_ms, now_ms])
        for mark, at_ms, rows in self._marks:
            mark.set_data(at_ms[at_ms <= now_ms], rows[at_ms <= now_ms])
        past = self._times_ms <= now_ms
        for number, curve in self._curves.items():
            curve.set_data(self._times_ms[past], 100 * self._played.probabilities[past, number])
        self._say_prediction(now_ms)
        if now_ms >= self._decided_ms:
            self._say_decision()
        self._canvas.draw()
        return Image.fromarray(np.array(self._canvas.buffer_rgba())).convert("RGB")

    def _make_figure(self, name):
        """Axes of the sensor and the prediction, and those with a time axis."""
        heights = [1.0] * len(self._played.layers) + [1.4]
        size = (10, 1.2 + 1.2 * len(heights))
        self._figure = figure = Figure(figsize=size, layout="constrained", dpi=90)
        figure.set_facecolor(find_colour("panel"))
        figure.get_layout_engine().set(w_pad=0.12, h_pad=0.06)
        sensor_figure, time_figure = figure.subfigures(1, 2, width_ratios=[1, 2.2])
        axes = sensor_figure.subplots(2, 1, height_ratios=[1.6, 1])
        panels = time_figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
        remark = "simulated " if self._spec.provenance.simulated else ""
        title = f"{remark}sample {name}, class {self._classes[self._label]}"
        time_figure.suptitle(title, ha="center")
        return axes, panels

    def _add_sensor(self, axes):
        """Add the sensor; return the function that draws values on it."""
        draw = _draw_sensor(axes, self._growing, read_positions(self._spec))
        axes.set(xticks=[], yticks=[])
        is_image = len(self._growing) == 1
        axes.set_title("events of each taxel" if is_image else "input spikes so far")
        return draw

    def _add_prediction(self, axes):
        """Add the texts of the predicted class and of its probability."""
        axes.set_axis_off()
        middle = {"x": 0.5, "ha": "center", "va": "center"}
        size = min(48, 400 / max(map(len, self._names)))
        bold = {"size": size, "color": find_colour("soft"), "weight": "bold"}
        self._prediction = axes.text(y=0.7, s="…", **bold, **middle)
        self._verdict = axes.text(y=0.15, s="", size=14, **middle)

    def _add_clocks(self, panels):
        """Add the present time, and what is shown from the decision on: its line, and a veil."""
        for axes in panels:
            axes.spines[:].set_visible(False)
        self._clocks = [axes.axvline(0, color=find_colour("soft"), linewidth=1) for axes in panels]
        solid = {"color": find_colour("ink"), "linewidth": 2, "visible": False}
        self._ends = [axes.axvline(self._decided_ms, **solid) for axes in panels]
        # What comes after the decision does not count, and is faded.
        faded = {"color": "white", "alpha": 0.6, "linewidth": 0, "zorder": 2.4, "visible": False}
        for axes in panels:
            self._ends.append(axes.axvspan(self._decided_ms, self.extent_ms, **faded))

    def _add_spikes(self, panels):
        """Add the layers; return a list of (line, times of its spikes, their rows)."""
        marks = []
        for axes, layer in zip(panels, self._played.layers, strict=False):
            axes.set(ylim=(layer.size - 0.5, -0.5), xlim=(0, self.extent_ms), yticks=[])
            title = f"{layer.name}\n{layer.size} {layer.unit}"
            axes.set_ylabel(title, rotation=0, ha="right", va="center")
            for group, steps, rows in layer.groups:
                name = "ink" if group == "s1" else group
                tall = {"markersize": max(1, 60 / layer.size), "label": NAMES.get(group)}
                line = axes.plot([], [], "|", color=find_colour(name), **tall)[0]
                marks.append((line, self._step_ms * (steps + 0.5), rows))
            if len(layer.groups) > 1:
                legend = axes.legend(**LEGEND, markerscale=max(1, layer.size / 7))
                for mark in legend.get_lines():
                    mark.set_markeredgewidth(4)
        return marks

    def _add_probabilities(self, axes):
        """Add the probabilities; return the curve of each drawn class."""
        threshold = 100 * self._spec.presentation.threshold_or_1
        decides = f"\n(decides at {threshold:.1f})" if threshold < 100 else ""
        speed = self.extent_ms / (FRAMES * FRAME_MS)
        pace = f"{speed:.2g} times faster" if speed > 1 else f"{1 / speed:.2g} times slower"
        axes.set(
            ylim=(0, 106),
            xlabel=f"milliseconds, shown {pace}",
            ylabel=f"{self._measure}, %{decides}",
        )
        curves = {}
        drawn = self._played.choose_classes(self._label)
        for place, (number, style) in enumerate(zip(drawn, STYLES, strict=False), 1):
            name = shorten_name(self._classes[number], MAX_NAME_LENGTH)
            curves[number] = axes.plot([], [], find_colour(f"s{place}"), ls=style, label=name)[0]
        axes.axhline(threshold, color=find_colour("soft"), linestyle=":", visible=threshold < 100)
        axes.legend(**LEGEND)
        return curves

    def _say_prediction(self, now_ms):
        """The prediction so far; that of the decision from then on."""
        step = np.searchsorted(self._times_ms, now_ms, side="right") - 1
        step = min(step, self._played.decided)
        if step < 0:
            return
        probabilities = self._played.probabilities[step]
        likely = probabilities.max()
        self._prediction.set_text(
            self._names[probabilities.argmax()] if likely >= MIN_SHOWN else "…"
        )
        self._verdict.set_text(f"{self._measure} {_format_percent(likely)}")

    def _say_decision(self):
        """The decision, when it was made, and whether it is right."""
        played = self._played
        label = self._label
        is_right = played.prediction == label
        is_last = self._decided_ms == self._times_ms[-1]
        when = "at the end" if is_last else f"decided after {self._decided_ms / 1000:.2f} s"
        probability = played.probabilities[played.decided, played.prediction]
        when += f"\n{self._measure} {_format_percent(probability)}"
        ended = f"{when}: right" if is_right else f"{when}\nwrong, was {self._names[label]}"
        shade = find_colour("right" if is_right else "wrong")
        self._prediction.set(text=self._names[played.prediction], color=shade)
        self._verdict.set_text(ended)
        for line in self._ends:
            line.set_visible(True)


def _format_percent(share):
    return f"{min(100 * share, 99.9):.3g} %"


def _draw_sensor(axes, growing, positions):
    """Draw an empty picture of the sensor; return the function that draws values on it."""
    shades = {"cmap": SHADES, "vmin": 0, "vmax": growing[-1].max()}
    if positions is None:
        rows, columns = growing.shape[1:]
        across = (1, 0) if rows == 1 else (0, 1)  # a strip runs down, like the rows of its raster
        image = axes.imshow(growing[0].transpose(across) * 0, aspect="auto", **shades)
        axes.set_box_aspect(np.clip(columns if rows == 1 else rows / columns, 0.25, 4))
        most = f"\ndarkest at the end: {growing[-1].max()} spikes" * (len(growing) > 1)
        axes.set_xlabel(f"{rows} x " * (rows > 1) + f"{columns} taxels{most}")
        return lambda values: image.set_data(values.transpose(across))
    dots = axes.scatter(*positions.T, 120, 0 * positions[:, 0], edgecolors="0.7", **shades)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.margins(0.1)
    return lambda values: dots.set_array(values[0])


def _accumulate_events(sample):
    """The events of each taxel up to each step, or the image, shape (steps, rows, columns)."""
    if sample.ndim == 3:
        return np.abs(sample).sum(-1)[None]
    return np.cumsum(sample.sum(-1, dtype=np.int64), axis=0)
