"""Rigs by the names that users write: configuration and device."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from daq.config import check, yaml_file
from daq.config.rig import RigConfig, UserLimit, with_options
from daq.config.yaml_file import Key, YamlFile
from daq.errors import ConfigError
from daq.hal import Device
from daq.limits import Limit
from daq.lookup.classes import find_class
from daq.lookup.shipped import find_file
from daq.progress import Note, Watch, ignore

DEFAULT_RIG = "simulated.yaml"


def rig_for(experiment: str, watch: Watch = ignore) -> str:
    """The rig file that an experiment's file says it is for; the simulated rig's without.

    Raises ConfigError that names the line where that file is not there.
    """
    try:
        file = yaml_file.load(find_file("protocol", experiment, watch))
    except ConfigError:
        return DEFAULT_RIG  # what is wrong with the experiment is told when it is loaded
    name = file.content.get("rig")
    if not isinstance(name, str) or not name:
        return DEFAULT_RIG
    beside = file.path.parent / name
    if beside.exists():
        return str(beside)
    try:
        find_file("backend", name)
    except ConfigError as error:
        raise ConfigError.of(file.blamed(("rig",), error)) from None
    return name


def load_rig(
    name: str, options: Mapping[str, Any] | None = None, watch: Watch = ignore
) -> tuple[RigConfig, Device]:
    """Read and check a rig file; its configuration and the backend's device, not yet open.

    options: the backend's own settings that take precedence over the file's.
    """
    file = yaml_file.load(find_file("backend", name, watch))
    check.refuse_other_kind(file, "a rig")
    if options:
        content = yaml_file.merge(file.content, {"options": options})
        file = replace(file, content=content)
    backend_name, backend = _backend(file)
    config = check.validate(file, with_options(backend.Options))
    class_name = f"{backend.__module__}.{backend.__qualname__}"
    watch(Note("detail", f"{file.path}: backend {backend_name} is {class_name}"))
    for index, limit in enumerate(config.limits.own):
        limit._make = _limit_maker(file, limit, ("limits", "own", index))
    config = _with_fitting_limits(config, watch)
    for idle in config.idle_limits:
        place = file.mistake(("limits", *idle.key.split(".")), "")
        watch(Note("warning", replace(idle, key="").behind(place).text))
    device: Device = backend(config.options)
    return config, device


def rig_on(
    rig: str, port: str | None, realtime: bool = False, watch: Watch = ignore
) -> tuple[RigConfig, Device]:
    """``load_rig`` on a port in place of its file's, or simulated at the pace of the clock.

    Raises ConfigError for a port where the backend has none.
    """
    config, device = load_rig(rig, watch=watch)
    fields = type(config.options).model_fields
    if port is not None and "port" not in fields:
        raise ConfigError(
            f"--port {port}: the backend {config.backend!r} of {rig} has no port",
            cure="name the rig file of one that has, such as --rig serial.yaml",
        )
    changes = {} if port is None else {"port": port}
    if realtime and "time" in fields:
        changes["time"] = "real"
    elif realtime:
        watch(Note("note", f"{rig}: its own clock paces it; --realtime changes nothing"))
    if changes:
        config, device = load_rig(rig, changes, watch)
    return config, device


def _backend(file: YamlFile) -> tuple[str, Any]:
    """Name and class of a rig's backend; ConfigError with all mistakes of its file."""
    name = file.content.get("backend", RigConfig.model_fields["backend"].default)
    if not isinstance(name, str):
        check.validate(file, RigConfig)
    try:
        return name, find_class("backend", name, file.path.parent)
    except ConfigError as error:
        check.validate(file, RigConfig, others=file.blamed(("backend",), error))
        raise


def _with_fitting_limits(config: RigConfig, watch: Watch) -> RigConfig:
    """Without the limit of a cable where the simulated plant has none."""
    least = config.limits.winding
    if least is None or getattr(config.options, "cable", True):
        return config
    text = f"limits.winding of {least:g} turns is left out: options.plant.load is without a cable"
    watch(Note("note", text))
    limits = config.limits.model_copy(update={"winding": None})
    return config.model_copy(update={"limits": limits})


def _limit_maker(file: YamlFile, limit: UserLimit, key: Key) -> Callable[[], Limit]:
    """What makes the limit that an entry of ``limits.own`` names, its settings checked."""
    try:
        kind: type[Limit] = find_class("limit", limit.use, file.path.parent)
    except ConfigError as error:
        raise ConfigError.of(file.blamed((*key, "use"), error)) from None
    if kind.Options is None:
        if limit.options:
            raise file.error((*key, "options"), f"the limit {limit.use} has no settings")
        return kind
    settings = check.validate(file, kind.Options, limit.options, (*key, "options"))
    make: Callable[..., Limit] = kind
    return lambda: make(settings)
