"""Models on their way to another process.

A process model is made of plain functions: of a user's file that no other machine has, of a
closure, of a script. What is not installed travels as code; what is (the standard library,
packages, this one) as its name. An array unpickled from a parcel may be written to, as may one
made here: the kernels are compiled for such, and would be compiled again for others.
"""

import pickle
import sys
import sysconfig
import threading
import types
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from sysid.problem.model import ModelError

# Folders that installers make: of Python, and of Debian's packages.
_INSTALLED = {"site-packages", "dist-packages"}
# Packages that are installed together, also where this one runs from its sources.
_EVERYWHERE = {"daq", "haptics", "protocols", "sim_rig", "sysid", "__main__"}
_REGISTRY = threading.Lock()  # what travels as code is noted once for all threads of a worker


def pack(what: str, value: Any) -> bytes:
    """Bytes from which any process with this package makes ``value`` again by ``unpack``.

    what: name of it for the ModelError raised when it cannot travel.
    """
    import cloudpickle

    try:
        with _REGISTRY, ExitStack() as stack:
            registered = cloudpickle.list_registry_pickle_by_value()
            for module in _not_installed():
                if module.__name__ in sys.modules and module.__name__ not in registered:
                    cloudpickle.register_pickle_by_value(module)
                    stack.callback(cloudpickle.unregister_pickle_by_value, module)
            parcel: bytes = cloudpickle.dumps(value)
    except (pickle.PicklingError, TypeError, ValueError) as error:
        raise ModelError(
            f"{what} cannot be sent to another process: {error}\n"
            "  Its functions and settings may refer to numbers, functions and modules; not to "
            "open files, locks or connections."
        ) from None
    return parcel


def unpack(parcel: bytes) -> Any:
    """The packed value, equal and independent."""
    return pickle.loads(parcel)


def _not_installed() -> Iterator[types.ModuleType]:
    """Loaded modules that another process may not find by their name."""
    paths = sysconfig.get_paths()
    places = {paths[key] for key in ("stdlib", "platstdlib", "purelib", "platlib")}
    for name, module in list(sys.modules.items()):
        file = Path(getattr(module, "__file__", None) or "")
        # Compiled modules have no code that could travel.
        if file.suffix != ".py" or name.partition(".")[0] in _EVERYWHERE:
            continue
        # Another environment's folder will do as well.
        installed = not _INSTALLED.isdisjoint(file.parts)
        if not installed and not any(file.is_relative_to(place) for place in places):
            yield module
