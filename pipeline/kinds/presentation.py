"""How events are presented: the length of a step, the number of steps, and the gap before a sample.

Recordings may last milliseconds or minutes, but a presentation should have some hundred steps: with
fewer, the order of the events is lost, with more, a presentation takes long.  So the length of a
step follows the recordings.  The neurons' initial time constants follow it where recordings are
short, and the gap follows the time constants, so that little is left of a sample when the next one
begins.
"""

import math
from dataclasses import replace

from deploy import limits
from deploy.network.chip import LOIHI
from deploy.network.presentation import Presentation
from deploy.network.spec import NetworkSpec
from deploy.terminal import WARNING
from pipeline.recordings.recordings import Recordings
from pipeline.recordings.sensor import Sensor
from pipeline.settings import Choice, Settings

# Minimum and maximum number of steps of a presentation of events.
MIN_STEPS = 50
MAX_STEPS = 400

# Mantissas of the lengths of a step that are chosen below the default.
MANTISSAS = (5, 2, 1)

# Shortest length of a step in milliseconds.
MIN_STEP_MS = 0.001

# Presentations of at least this many milliseconds have the default time constants; shorter
# ones have them in proportion.
FULL_TIME_CONSTANTS_MS = 500.0

# Largest share of its threshold that a neuron may receive, in all steps of the next sample
# together, from the current that is left of a sample.
MAX_SHARE_LEFT = 0.1

# The same for images, whose neurons receive many thresholds from each sample: with it the default
# gap is that for the default time constant.
MAX_SHARE_LEFT_OF_IMAGE = 0.71

# Time constants of currents after the training, in multiples of the initial ones: 0.77 to 1.34
# were seen.
MAX_GROWTH = 1.35


def choose_presentation(
    settings: Settings, recordings: Recordings, may_shorten: bool = False
) -> list[Choice]:
    """Present events for as long as the recordings last, with a suitable length of steps.

    Parameters
    ----------
    settings : Settings
    recordings : Recordings
    may_shorten : bool
        True if the step may also become shorter, for short recordings.
    """
    if settings.presentation.steps or recordings.sensor.duration_s == Sensor().duration_s:
        return []  # as long as the published recordings: the default fits
    longest_ms = float(recordings.table.duration_ms.max(initial=0))
    step_ms = settings.input.step_ms
    if settings.is_open("input.step") and settings.is_open("input.refractory"):
        step_ms = choose_step_ms(longest_ms, step_ms, may_shorten)
    steps = min(max(math.floor(longest_ms / step_ms) + 1, MIN_STEPS), MAX_STEPS)
    reason = _describe_reason(steps, step_ms, longest_ms)
    choices = [Choice("presentation.steps", steps, f"{steps} steps of {step_ms:g} ms: {reason}")]
    if step_ms != settings.input.step_ms:
        choices.append(Choice("input.step", step_ms))
        choices.append(Choice("input.refractory", step_ms))
    return choices


def choose_step_ms(longest_ms: float, default_ms: float, may_shorten: bool = True) -> float:
    """Choose the length of a step, so that the longest recording has from 50 to 400 steps.

    Parameters
    ----------
    longest_ms : float
        Time of the last event of all recordings in milliseconds.
    default_ms : float
        The length that is kept if it suits the recordings.
    may_shorten : bool
        True if the result may be shorter than the default.

    Returns
    -------
    float
        The default; a multiple of it by a power of two; or the longest of 5, 2, 1, 0.5, ... below
        the default that is short enough.
    """
    if longest_ms >= default_ms * MAX_STEPS:
        doublings = math.floor(math.log2(longest_ms / (default_ms * MAX_STEPS))) + 1
        return default_ms * 2**doublings
    if not may_shorten or longest_ms == 0 or longest_ms >= default_ms * MIN_STEPS:
        return default_ms
    longest_step = max(longest_ms / MIN_STEPS, MIN_STEP_MS)
    decade = 10.0 ** math.floor(math.log10(longest_step) + 1e-9)
    fits = (mantissa * decade for mantissa in MANTISSAS)
    return float(f"{next(step for step in fits if step <= longest_step * (1 + 1e-9)):.3g}")


def _describe_reason(steps, step_ms, longest_ms):
    """Why there are so many steps of this length."""
    if longest_ms < (steps - 1) * step_ms:
        return f"the fewest; the recordings last up to {longest_ms / 1000:.2g} s"
    if longest_ms >= steps * step_ms:
        return (
            f"the first {steps * step_ms / 1000:g} s of recordings of up to "
            f"{longest_ms / 1000:.4g} s (more: a longer --set input.step=..., or --steps)"
        )
    return "as long as the recordings last"


def choose_time_constants(settings: Settings) -> list[Choice]:
    """Choose the initial time constants of neurons on events, and the gap between samples.

    Parameters
    ----------
    settings : Settings
        With the chosen presentation.
    """
    choices = []
    currents_ms = settings.events.tau_u_ms
    voltages_ms = settings.events.tau_v_ms
    presented_ms = settings.steps * settings.input.step_ms
    are_open = settings.is_open("events.tau_u_ms") and settings.is_open("events.tau_v_ms")
    if presented_ms < FULL_TIME_CONSTANTS_MS and are_open:
        currents_ms = shorten_time_constants(currents_ms, presented_ms)
        voltages_ms = shorten_time_constants(voltages_ms, presented_ms)
        reason = (
            f"initial time constants of {currents_ms[0]:g} ms (current) and {voltages_ms[0]:g} ms "
            f"(voltage), for presentations of {presented_ms:g} ms (others: --set "
            "events.tau_u_ms=[...])"
        )
        choices.append(Choice("events.tau_u_ms", currents_ms, reason))
        choices.append(Choice("events.tau_v_ms", voltages_ms))
    if settings.is_open("presentation.gap"):
        gap = count_silent_steps(MAX_GROWTH * max(currents_ms) / settings.input.step_ms)
        if gap > settings.presentation.gap:
            reason = (
                f"gap of {gap} silent steps before each sample: then the currents that are left of "
                f"the sample before add at most {MAX_SHARE_LEFT:g} of a neuron's threshold "
                "(another: --set presentation.gap=...)"
            )
            choices.append(Choice("presentation.gap", gap, reason))
    return choices


def shorten_time_constants(taus_ms: tuple, presented_ms: float) -> tuple:
    """Time constants in proportion to a short presentation, to two digits."""
    share = presented_ms / FULL_TIME_CONSTANTS_MS
    return tuple(float(f"{tau * share:.2g}") for tau in taus_ms)


def choose_image_gap(settings: Settings) -> tuple:
    """Choose the gap between images for the time constant of the currents.

    Parameters
    ----------
    settings : Settings

    Returns
    -------
    gap : int or None
        None if the gap of the settings is the user's or suffices, or each sample begins at rest.
    reason : str
    """
    presentation = settings.presentation
    tau = settings.deployment.synapse_s / LOIHI.dt
    gap = count_silent_steps(tau, MAX_SHARE_LEFT_OF_IMAGE) if tau else 0
    is_open = settings.is_open("presentation.gap")
    if not is_open or presentation.stream_length == 1 or gap <= presentation.gap:
        return None, ""
    return gap, (
        f"gap of {gap} silent steps before each sample, for currents with a time constant of "
        f"{tau:g} steps (another: --set presentation.gap=...)"
    )


def list_current_taus(spec: NetworkSpec) -> dict:
    """Time constants of the currents of a network's layers in steps, as for `fit_gap`."""
    taus = {f"{layer.name}.tau_u": (layer.synapse or 0.0) / LOIHI.dt for layer in spec.layers}
    return {name: tau for name, tau in taus.items() if tau}


def count_silent_steps(tau_current: float, share: float = MAX_SHARE_LEFT) -> int:
    """Number of silent steps after which little is left of a sample.

    In each step a neuron's current is added to its voltage and then multiplied by
    d = exp(-1 / tau).  After n steps without spikes a current of one threshold, with which a neuron
    fires in every step, has become d^n thresholds, and all later steps together add d^n / (1 - d)
    thresholds to the voltage.  The result is the smallest n for which this is at most ``share``.

    The voltage that is left is not counted: it is below one threshold and changes the number of a
    neuron's spikes in the next sample by one at most.

    Parameters
    ----------
    tau_current : float
        Time constant of the current in steps.
    share : float
        What may still be added to the voltage, in thresholds.

    Returns
    -------
    int
        At most :data:`deploy.limits.STEPS`.
    """
    added = -1 / math.expm1(-1 / tau_current)
    steps = math.ceil(tau_current * math.log(added / share) - 1e-9)
    return min(max(steps, 0), limits.STEPS)


def fit_gap(presentation: Presentation, taus: dict, is_users: bool) -> tuple[Presentation, str]:
    """Lengthen the gap for the trained time constants, or warn if the gap is the user's.

    Parameters
    ----------
    presentation : Presentation
    taus : dict of str to float
        The trained time constants of currents, in steps, by names such as ``"conv1.tau_u"``.
    is_users : bool
        True if the user has set the gap, which then stays.

    Returns
    -------
    presentation : Presentation
        With a gap after which little is left of a sample.
    line : str
        A note for the user; empty if the gap is long enough, or if each sample begins at rest.
    """
    if presentation.stream_length == 1 or not taus:
        return presentation, ""
    name = max(taus, key=taus.__getitem__)
    needed_gap = count_silent_steps(taus[name])
    if needed_gap <= presentation.gap:
        return presentation, ""
    layer = f"layer {name.removesuffix('.tau_u')} (time constant {taus[name]:.3g} steps)"
    if is_users:
        return presentation, (
            f"{WARNING}the currents of {layer} outlast the gap of {presentation.gap} steps between "
            f"samples, which therefore disturb each other: --set presentation.gap={needed_gap}, or "
            "--set presentation.stream_length=1, so that each sample begins at rest"
        )
    return replace(presentation, gap=needed_gap), (
        f"gap of {needed_gap} silent steps before each sample, for the currents of {layer} after "
        "the training (another: --set presentation.gap=...)"
    )
