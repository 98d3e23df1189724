"""Configurations of Keras 1 with the names of Keras 2."""

# Names of arguments in Keras 1, and in Keras 2.
ARGUMENTS = {
    "nb_filter": "filters",
    "subsample": "strides",
    "border_mode": "padding",
    "dim_ordering": "data_format",
    "output_dim": "units",
    "bias": "use_bias",
    "p": "rate",
    "sigma": "stddev",
}
CLASSES = {"Convolution2D": "Conv2D", "Model": "Functional"}
DATA_FORMATS = {"tf": "channels_last", "th": "channels_first"}
# Arguments that act in training only, or repeat what other arguments have.
UNUSED = (
    *("init", "gamma_init", "beta_init", "input_dim", "mode", "input_dtype"),
    *("W_regularizer", "b_regularizer", "activity_regularizer", "W_constraint", "b_constraint"),
    *("gamma_regularizer", "beta_regularizer", "W_learning_rate_multiplier"),
    *("b_learning_rate_multiplier", "seed", "noise_shape"),
)


def convert_config(config: dict) -> dict:
    """Convert the configuration of a model or layer.

    Parameters
    ----------
    config : dict
        ``{"class_name": ..., "config": ...}`` from the attribute ``model_config`` of a file.
    """
    kind = config["class_name"]
    inside = config["config"]
    if isinstance(inside, list):  # a sequential model
        inside = {"name": "sequential", "layers": [convert_config(layer) for layer in inside]}
    elif "layers" in inside:
        inside = {**inside, "layers": [convert_config(layer) for layer in inside["layers"]]}
    else:
        inside = _convert_arguments(inside)
    return {**config, "class_name": CLASSES.get(kind, kind), "config": inside}


def _convert_arguments(arguments):
    converted = {
        ARGUMENTS.get(name, name): value
        for name, value in arguments.items()
        if name not in (*UNUSED, "nb_row", "nb_col")
    }
    if "nb_row" in arguments:
        converted["kernel_size"] = [arguments["nb_row"], arguments["nb_col"]]
    if converted.get("data_format") in DATA_FORMATS:
        converted["data_format"] = DATA_FORMATS[converted["data_format"]]
    return converted
