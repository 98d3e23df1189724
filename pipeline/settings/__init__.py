"""The settings of an experiment: their schema, their file, and their text on the command line."""

from pipeline.settings.base import SettingsGroup, UndeclaredSetting
from pipeline.settings.choices import Choice, Provenance, apply_choices, list_reasons
from pipeline.settings.groups import (
    AGGREGATIONS,
    AUGMENTATIONS,
    CNN,
    INPUTS,
    NIR,
    NORMALISATIONS,
    SIMULATED,
    SNN,
    SNN_RECIPES,
    Check,
    Data,
    Deployment,
    EventTraining,
    Image,
    Input,
    PresentationSettings,
    SkinSize,
    SplitShares,
)
from pipeline.settings.nested import find_value, merge_values, set_nested, suggest_name
from pipeline.settings.relations import IMPORTED
from pipeline.settings.schema import KEPT_SETTINGS, PATHS, Settings, list_names_in
from pipeline.settings.text import (
    describe_settings,
    format_automatic,
    format_settings,
    parse_assignments,
)
from pipeline.settings.toml import read_own_settings, read_settings, write_settings

__all__ = [
    "AGGREGATIONS",
    "AUGMENTATIONS",
    "CNN",
    "IMPORTED",
    "INPUTS",
    "KEPT_SETTINGS",
    "NIR",
    "NORMALISATIONS",
    "PATHS",
    "SIMULATED",
    "SNN",
    "SNN_RECIPES",
    "Check",
    "Choice",
    "Data",
    "Deployment",
    "EventTraining",
    "Image",
    "Input",
    "PresentationSettings",
    "Provenance",
    "Settings",
    "SettingsGroup",
    "SkinSize",
    "SplitShares",
    "UndeclaredSetting",
    "apply_choices",
    "describe_settings",
    "find_value",
    "format_automatic",
    "format_settings",
    "list_names_in",
    "list_reasons",
    "merge_values",
    "parse_assignments",
    "read_own_settings",
    "read_settings",
    "set_nested",
    "suggest_name",
    "write_settings",
]
