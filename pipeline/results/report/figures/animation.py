"""An animation of a sample of a check: touch, spikes of the layers and probabilities over time."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from deploy.check.bundle import Bundle
from deploy.files import replacing, require_ending
from deploy.network.provenance import read_classes, read_positions
from deploy.tables import shorten_name
from pipeline.look import colour
from pipeline.results.report.figures import SHADES
from pipeline.results.report.samples import replay

# Number of frames, and the duration of each and of the last one in milliseconds.
FRAMES, FRAME_MS, LAST_MS = 48, 60, 3000

LONGEST_NAME = 32

NAMES = {"on": "ON: rises", "off": "OFF: falls"}
# Of the curves, for those who do not see their colours.
STYLES = ("-", "--", ":", "-.")
# Probability below which a prediction is not shown: it would only flicker.
LIKELY = 0.4


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
    spec = bundle.spec
    played = replay(bundle, [index], bundle.seed)[index]
    classes, chances = read_classes(spec), played.chances
    step, start = 1000 * spec.stimulus.step_seconds, spec.presentation.readout_start
    extent = step * spec.presentation.steps
    label, answer = int(bundle.checks.labels[index]), played.answer
    times = step * (start + 1 + np.arange(len(chances)))
    heights = [1.0] * len(played.layers) + [1.4]
    figure = Figure(figsize=(10, 1.2 + 1.2 * len(heights)), layout="constrained", dpi=90)
    figure.set_facecolor(colour("panel"))
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.06)
    left, right = figure.subfigures(1, 2, width_ratios=[1, 2.2])
    picture, said = left.subplots(2, 1, height_ratios=[1.6, 1])
    panels = right.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    kind = "simulated " if spec.provenance.get("simulated") else ""
    right.suptitle(f"{kind}sample {bundle.checks.ids[index]}, class {classes[label]}", ha="center")
    growing = _growing(bundle.checks.inputs[index])
    draw = _picture(picture, growing, read_positions(spec))
    picture.set(xticks=[], yticks=[])
    picture.set_title("input spikes so far" if len(growing) > 1 else "events of each taxel")
    said.set_axis_off()
    middle = {"x": 0.5, "ha": "center", "va": "center"}
    names = [shorten_name(name, 16) for name in classes]
    size = min(48, 400 / max(map(len, names)))
    answered = said.text(y=0.7, s="…", size=size, color=colour("soft"), weight="bold", **middle)
    verdict = said.text(y=0.15, s="", size=14, **middle)
    for axes in panels:
        axes.spines[:].set_visible(False)
    clocks = [axes.axvline(0, color=colour("soft"), linewidth=1) for axes in panels]
    end, solid = times[played.decided], {"color": colour("ink"), "linewidth": 2, "visible": False}
    ends = [axes.axvline(end, **solid) for axes in panels]
    # What comes after the decision does not count, and is faded.
    faded = {"color": "white", "alpha": 0.6, "linewidth": 0, "zorder": 2.4, "visible": False}
    ends += [axes.axvspan(end, extent, **faded) for axes in panels]
    marks = []
    for axes, layer in zip(panels, played.layers, strict=False):
        axes.set(ylim=(layer.size - 0.5, -0.5), xlim=(0, extent), yticks=[])
        title = f"{layer.name}\n{layer.size} {layer.unit}"
        axes.set_ylabel(title, rotation=0, ha="right", va="center")
        for kind, steps, rows in layer.groups:
            tall = {"markersize": max(1, 60 / layer.size), "label": NAMES.get(kind)}
            line = axes.plot([], [], "|", color=colour("ink" if kind == "s1" else kind), **tall)[0]
            marks.append((line, step * (steps + 0.5), rows))
        if len(layer.groups) > 1:
            where = {"loc": "center left", "bbox_to_anchor": (1, 0.5), "frameon": False}
            legend = axes.legend(**where, fontsize=9, markerscale=max(1, layer.size / 7))
            for mark in legend.get_lines():
                mark.set_markeredgewidth(4)
    scores = panels[-1]
    limit = 100 * spec.presentation.threshold
    measure = "probability" if spec.estimator else "softmax"
    probability = f"{measure}, %" + f"\n(decides at {limit:.1f})" * (limit < 100)
    speed = extent / (FRAMES * FRAME_MS)
    speed = f"{speed:.2g} times faster" if speed > 1 else f"{1 / speed:.2g} times slower"
    scores.set(ylim=(0, 106), xlabel=f"milliseconds, shown {speed}", ylabel=probability)
    lines = {
        c: scores.plot(
            [], [], colour(f"s{n}"), ls=ls, label=shorten_name(classes[c], LONGEST_NAME)
        )[0]
        for n, (c, ls) in enumerate(zip(played.shown(label), STYLES, strict=False), 1)
    }
    scores.axhline(limit, color=colour("soft"), linestyle=":", visible=limit < 100)
    scores.legend(loc="center left", bbox_to_anchor=(1, 0.5), fontsize=9, frameon=False)
    when = "at the end" if end == times[-1] else f"decided after {end / 1000:.2f} s"
    when += f"\n{measure} {_percent(chances[played.decided, answer])}"
    ended = f"{when}: right" if answer == label else f"{when}\nwrong, was {names[label]}"
    canvas, frames = FigureCanvasAgg(figure), []
    canvas.draw()
    figure.set_layout_engine("none")  # of the first frame, for all
    for now in np.linspace(0, extent, FRAMES):
        draw(growing[min(int(now / step), len(growing) - 1)] * (now > 0 or len(growing) == 1))
        for clock in clocks:
            clock.set_xdata([now, now])
        for mark, at, neurons in marks:
            mark.set_data(at[at <= now], neurons[at <= now])
        for c, line in lines.items():
            line.set_data(times[times <= now], 100 * chances[times <= now, c])
        step_now = min(np.searchsorted(times, now, side="right") - 1, played.decided)
        if step_now >= 0:
            likely = chances[step_now].max()
            answered.set_text(names[chances[step_now].argmax()] if likely >= LIKELY else "…")
            verdict.set_text(f"{measure} {_percent(likely)}")
        if now >= end:
            answered.set(text=names[answer], color=colour("right" if answer == label else "wrong"))
            verdict.set_text(ended)
            for line in ends:
                line.set_visible(True)
        canvas.draw()
        frames.append(Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB"))
        if advance is not None:
            advance()
    # The result is first, too: some programs show the first frame only.
    timing = {"duration": [FRAME_MS] * FRAMES + [LAST_MS], "loop": 0}
    with replacing(path) as file:
        frames[-1].save(file, "gif", save_all=True, append_images=frames, **timing)


def _percent(share):
    return f"{min(100 * share, 99.9):.3g} %"


def _picture(axes, growing, positions):
    """Draw an empty picture of the sensor; return the function that draws values on it."""
    shades = {"cmap": SHADES, "vmin": 0, "vmax": growing[-1].max()}
    if positions is None:
        rows, columns = growing.shape[1:]
        across = (1, 0) if rows == 1 else (0, 1)  # a strip runs down, like the rows of its raster
        image = axes.imshow(growing[0].transpose(across) * 0, aspect="auto", **shades)
        axes.set_box_aspect(np.clip(columns if rows == 1 else rows / columns, 0.25, 4))
        most = f"; darkest at the end: {growing[-1].max()}" * (len(growing) > 1)
        axes.set_xlabel(f"{rows} x " * (rows > 1) + f"{columns} taxels{most}")
        return lambda values: image.set_data(values.transpose(across))
    dots = axes.scatter(*positions.T, 120, 0 * positions[:, 0], edgecolors="0.7", **shades)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.margins(0.1)
    return lambda values: dots.set_array(values[0])


def _growing(sample):
    """The events of each taxel up to each step, or the image, shape (steps, rows, columns)."""
    if sample.ndim == 3:
        return np.abs(sample).sum(-1)[None]
    return np.cumsum(sample.sum(-1, dtype=np.int64), axis=0)
