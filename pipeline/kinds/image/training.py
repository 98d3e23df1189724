"""The steps of a run on images: its CNNs and its rate-LIF network are trained."""

from deploy.files import copy_file
from models.architecture import parse_architecture
from pipeline.kinds.diagnosis import compute_fastest_rate, describe_neurons, measure_activity
from pipeline.kinds.image.choices import choose_image_augmentation
from pipeline.kinds.image.keras_model import name_copied_model, read_usable_model
from pipeline.kinds.records import (
    describe_accuracy,
    list_training_versions,
    make_training_record,
    measure_accuracies,
    select_curve_samples,
    time_training,
    write_network,
)
from pipeline.training.images.schedules import make_cnn_schedule, make_snn_schedule


def make_cnn(inputs, artifact) -> dict:
    """Train the CNN, or read the user's own."""
    settings = inputs.settings
    dataset = inputs.dataset
    if settings.cnn.model:
        path, model = read_usable_model(artifact.folder, settings, dataset)
        trained, seconds = _adopt_model(model, settings, dataset, inputs.say)
        copy = name_copied_model(artifact.folder, settings)
        if path != copy:
            copy_file(path, copy)
    else:
        trained, seconds = _train_cnn(settings, dataset)
    write_network(artifact.folder, trained, not len(dataset.split.validation))
    metrics = make_training_record(trained, dataset, seconds, list_training_versions())
    inputs.say(describe_accuracy("cnn", metrics))
    return metrics


def make_matched_cnn(inputs, artifact) -> dict:
    """Train the CNN further, as the rate-based network is trained."""
    from pipeline.training.images.train import train_matched

    _, metrics = _train_further("cnn-matched", train_matched, inputs, artifact)
    inputs.say(describe_accuracy("cnn-matched", metrics))
    return metrics


def make_rate_network(inputs, artifact) -> dict:
    """Train the rate-LIF network, starting from the CNN."""
    from pipeline.training.images.rescaling import select_measured
    from pipeline.training.images.train import train_rate_network

    trained, metrics = _train_further("rate-lif", train_rate_network, inputs, artifact)
    images, _ = inputs.dataset.subset("train")
    measured = select_measured(images, parse_architecture(inputs.settings.cnn.architecture))
    metrics["neurons"] = _measure_activity(inputs.settings, trained, measured)
    inputs.say(describe_accuracy("rate-lif", metrics))
    if len(measured) < len(images):
        inputs.say(
            f"rate-lif: its neurons are measured on {len(measured)} of {len(images)} training "
            "samples, because they are many"
        )
    for line in describe_neurons(metrics["neurons"]):
        inputs.say(f"rate-lif: {line}")
    return metrics


def _train_cnn(settings, dataset, weights=None):
    """Train the CNN from given weights or from new ones; return it and the seconds."""
    from pipeline.training.images.train import train_cnn  # imports TensorFlow

    augmentation = settings.cnn.augment
    samples = _collect_samples(dataset, "none" if augmentation == "auto" else augmentation)
    epochs = make_cnn_schedule(settings.cnn, len(samples)).epochs

    def train(advance):
        return train_cnn(settings, samples, settings.seed, advance, weights)

    return time_training("cnn", epochs, train)


def _collect_samples(dataset, augmentation):
    """The training samples, how they are altered, and those of the learning curve."""
    from pipeline.training.images.epochs import TrainingSamples

    images, labels = dataset.subset("train")
    altered = dataset.make_altered_images(augmentation)
    return TrainingSamples(images, labels, altered, select_curve_samples(dataset))


def _adopt_model(model, settings, dataset, say):
    """The user's model as the CNN; it is trained further if something in it was replaced."""
    from pipeline.training.images.networks import TrainedCNN

    for note in (*model.notes, *model.replaced):
        say(f"cnn: {note}")
    adopted = TrainedCNN(settings, model.weights)
    if not model.replaced:
        return adopted, 0.0
    logits_of_file = model.compute_outputs(dataset.inputs)
    logits_of_adopted = adopted.compute_logits(dataset.inputs)
    trained, seconds = _train_cnn(settings, dataset, model.weights)
    logits_of_trained = trained.compute_logits(dataset.inputs)
    accuracies = [
        measure_accuracies(logits.argmax(1) == dataset.labels, dataset)["accuracy"]
        for logits in (logits_of_file, logits_of_adopted, logits_of_trained)
    ]
    part = list(accuracies[0])[-1]
    in_file, with_replacements, after_training = (
        f"{accuracy[part]:.3f}" for accuracy in accuracies
    )
    say(
        f"cnn: {part} accuracy {in_file} as in the file, {with_replacements} with what was "
        f"replaced, {after_training} after further training"
    )
    return trained, seconds


def _train_further(name, function, inputs, artifact):
    """Train a network that starts from the CNN; write it, and return it and its metrics."""
    settings = inputs.settings
    dataset = inputs.dataset
    augmentation = "none"
    if settings.snn.recipe == "loihi":
        augmentation = settings.cnn.augment
        if augmentation == "auto":
            augmentation = choose_image_augmentation(dataset.recordings)
    samples = _collect_samples(dataset, augmentation)
    epochs = make_snn_schedule(settings.snn, len(samples)).epochs
    cnn_weights = inputs.read_weights("cnn")

    def train(advance):
        return function(settings, samples, settings.seed, cnn_weights, advance)

    trained, seconds = time_training(name, epochs, train)
    write_network(artifact.folder, trained, not len(dataset.split.validation))
    metrics = make_training_record(trained, dataset, seconds, list_training_versions())
    return trained, {**metrics, "augment": augmentation}


def _measure_activity(settings, trained, images):
    """Shares of silent and saturated neurons of each layer on some images."""
    fastest = compute_fastest_rate(settings.snn.tau_ref)
    outputs = trained.compute_activations(images)
    return {
        name: measure_activity(output * settings.snn.get_max_rate(index), fastest)
        for index, (name, output) in enumerate(outputs.items())
    }
