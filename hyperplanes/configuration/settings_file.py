"""Settings files: YAML of the dataclasses of a model and its training, complete or in part.

preset: small               # for entries that are not given
method: hyperplanes
model: {hypernetwork: {views: 3}}
training: {learning_rate: 1e-3}
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import yaml

from hyperplanes.configuration.model import ModelConfig
from hyperplanes.configuration.presets import Preset
from hyperplanes.configuration.training import TrainingConfig
from hyperplanes.fields import find_targets
from hyperplanes.hypernetwork import KINDS
from hyperplanes.utilities.files.reading import MALFORMED, DataError, read_bytes
from hyperplanes.utilities.files.settings import SettingsError, structure
from hyperplanes.utilities.files.writing import write_whole
from hyperplanes.utilities.messages.arguments import kind_of
from hyperplanes.utilities.messages.errors import nearest

__all__ = ["changed", "document", "parse_options", "read_experiment", "write_experiment"]

ENTRIES = {"preset": str, "method": str, "model": dict, "training": dict}
MAX_SETTINGS_BYTES = 2**20  # bytes of a file


class _Loader(yaml.SafeLoader):
    """Plain values only, without aliases and repeated keys; 1e-3 is a number, as in YAML 1.2."""

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        if self.check_event(yaml.AliasEvent):
            raise yaml.YAMLError("an alias (*name), which is not supported")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        made = super().construct_mapping(node, deep)
        names = [name.value for name, _ in node.value]
        repeated = [name for place, name in enumerate(names) if name in names[:place]]
        if repeated:
            raise yaml.YAMLError(f"the entry {repeated[0]!r} more than once")
        return made


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def read_experiment(path: Path) -> dict[str, Any]:
    """The entries of a file.

    Args:
        path: YAML, such as the config.yaml that `train` writes beside its weights.

    Returns:
        Some of preset, method, model and training, whose content is not checked.

    Raises:
        DataError: a missing file, invalid YAML, or other entries.
    """
    remedy = "`hyperplanes presets quick` prints a whole one"
    try:
        text = read_bytes(path, MAX_SETTINGS_BYTES)
    except DataError:
        raise
    except OSError as error:
        raise DataError(path, "a YAML file of settings", error.strerror or str(error), "check the path") from None
    try:
        value = yaml.load(text, _Loader)  # noqa: S506 - a subclass of SafeLoader
    except (yaml.YAMLError, *MALFORMED) as error:
        raise DataError(path, "YAML", str(error) or type(error).__name__, remedy) from None
    if not isinstance(value, dict):
        raise DataError(path, "a mapping of settings", f"a {type(value).__name__}", remedy)
    for name, entry in value.items():
        if name not in ENTRIES:
            raise DataError(f"{path}: {name}: an unknown entry; {nearest(str(name), list(ENTRIES))}")
        if not isinstance(entry, ENTRIES[name]):
            raise DataError(path, f"{name} of type {ENTRIES[name].__name__}", type(entry).__name__, remedy)
    return value


def write_experiment(path: Path, chosen: Preset) -> None:
    """Write a file from which `read_experiment` and `changed` restore the same model and training."""
    write_whole(path, document(chosen).encode())


def document(chosen: Preset) -> str:
    """The complete YAML of a configuration."""
    entries = {"method": chosen.model.method, "model": chosen.model.as_json(), "training": asdict(chosen.training)}
    return yaml.safe_dump(entries, sort_keys=False)


def changed(chosen: Preset, changes: Mapping[str, Any]) -> Preset:
    """A configuration with some entries replaced.

    If the protocol changes, settings of its sampler that are not given have their defaults.

    Args:
        chosen: the configuration.
        changes: entries of `model` and `training`, nested as the dataclasses are.

    Returns:
        The new configuration.

    Raises:
        SettingsError: an unknown entry or an invalid value; its path begins with "model" or "training".
    """
    model, training = chosen.model.as_json(), asdict(chosen.training)
    try:
        path = "model"
        wanted = changes.get("model", {})
        if isinstance(wanted, Mapping) and wanted.get("protocol", model["protocol"]) != model["protocol"]:
            model["sampling"] = {}
        _change_kind(model, wanted)
        made = ModelConfig.structured(_merged(model, wanted))
        path = "training"
        trained = structure(TrainingConfig, _merged(training, changes.get("training", {})))
    except SettingsError as error:
        raise SettingsError(f"{path}.{error.path}" if error.path else path, error.problem) from None
    return replace(chosen, model=made, training=trained)


def _change_kind(model: dict[str, Any], wanted: Any) -> None:
    """Drops settings of the shape of network and hypernetwork that the wanted field and kind do not have."""
    if not isinstance(wanted, Mapping):
        return
    known = find_targets()
    if isinstance(target := wanted.get("target"), str) and target in known:
        shared = {each.name for each in fields(known[target].config_type)}
        model["network"] = {name: value for name, value in model["network"].items() if name in shared}
    hypernetwork = wanted.get("hypernetwork")
    kind = hypernetwork.get("kind") if isinstance(hypernetwork, Mapping) else None
    if isinstance(kind, str) and kind in KINDS and model["hypernetwork"] is not None:
        shared = {each.name for each in fields(KINDS[kind])}
        entries = {name: value for name, value in model["hypernetwork"].items() if name in shared}
        model["hypernetwork"] = entries


def _merged(base: Mapping[str, Any], changes: Any) -> Any:
    """A mapping with some entries replaced, recursively for nested mappings."""
    if not isinstance(changes, Mapping):
        return changes
    result = dict(base)
    for name, value in changes.items():
        before = result.get(name)
        if isinstance(value, Mapping):
            result[name] = _merged(before if isinstance(before, Mapping) else {}, value)
        elif isinstance(before, list | tuple) and isinstance(value, str | int | float):
            result[name] = [value]
        else:
            result[name] = value
    return result


def parse_options(given: Sequence[str]) -> dict[str, Any]:
    """The entries of command-line options.

    >>> parse_options(["--model.hypernetwork.views", "3", "--training.learning-rate=1e-3"])
    {'model': {'hypernetwork': {'views': 3}}, 'training': {'learning_rate': 0.001}}

    Args:
        given: options with a dot in their names, each followed by its value or values; True without one.

    Returns:
        Entries for `changed`.

    Raises:
        SettingsError: an option of neither the model nor the training, or an invalid value.
    """
    result: dict[str, Any] = {}
    for option, values in _grouped(given):
        names = option.replace("-", "_").split(".")
        if names[0] not in ("model", "training"):
            raise SettingsError(option, f"an unknown option; {nearest(names[0], ['model', 'training'])}")
        node = result
        for name in names[:-1]:
            node = node.setdefault(name, {})
            if not isinstance(node, dict):
                raise SettingsError(option, "given beside the whole of which it is a part; leave one of them out")
        try:
            read = [yaml.load(value, _Loader) for value in values]  # noqa: S506 - a subclass of SafeLoader
        except (yaml.YAMLError, *MALFORMED) as error:
            found, problem = kind_of(" ".join(values)), " ".join(str(error).split())
            raise SettingsError(option, f"expected a plain value, got {found} ({problem})") from None
        if isinstance(node.get(names[-1]), dict):
            raise SettingsError(option, "given beside a part of it; leave one of them out")
        node[names[-1]] = True if not read else read[0] if len(read) == 1 else read
    return result


def _grouped(given: Sequence[str]) -> list[tuple[str, list[str]]]:
    groups: list[tuple[str, list[str]]] = []
    for argument in given:
        if argument.startswith("--"):
            option, equals, value = argument[2:].partition("=")
            groups.append((option, [value] if equals else []))
        else:
            groups[-1][1].append(argument)
    return groups
