"""What was found of a model's equations, kept on disk beside its kernels.

The name of a file is a fingerprint of the equations, of all that the model declares, and of the
code that analyses them: of a changed model or code nothing is taken from it.
"""

import contextlib
import functools
import hashlib
import pickle
from importlib.metadata import version
from pathlib import Path

from sysid.engine.compiler import cache_folder, fingerprint, write_cached
from sysid.identifiability.analysis import identifiability
from sysid.identifiability.findings import Identifiability
from sysid.problem.model import ProcessModel


def kept_identifiability(model: ProcessModel) -> Identifiability:
    """``identifiability`` without sensors, from disk where the same has been asked before.

    >>> from sysid.examples import lag
    >>> kept_identifiability(lag()) == kept_identifiability(lag())
    True
    """
    folder = cache_folder()
    path = None if folder is None else folder / f"identifiability_{_key(model)}.pickle"
    if path is not None:
        # Not there, or cut short: whatever reading it raises, the analysis is made anew.
        with contextlib.suppress(Exception):
            kept = pickle.loads(path.read_bytes())
            if isinstance(kept, Identifiability):
                return kept
    result = identifiability(model, sensors=False)
    if path is not None:
        with contextlib.suppress(OSError):
            write_cached(path, pickle.dumps(result))
    return result


@functools.lru_cache(maxsize=8)
def _key(model: ProcessModel) -> str:
    signals = repr((model.states, model.inputs, model.outputs, model.parameters))
    key = hashlib.sha256(f"{fingerprint(model)}\n{version('python-flint')}\n{signals}".encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        key.update(source.read_bytes())
    return key.hexdigest()[:24]
