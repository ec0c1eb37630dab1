"""The run phase in open loop: a waveform known beforehand, played by the device's clock."""

import numpy as np

from daq.errors import DeviceError
from daq.hal import Flag, FloatArray, Mode
from daq.logs.writer import LogWriter
from daq.run.sampling import Sampling


def play(sampling: Sampling, log: LogWriter, commands: FloatArray) -> None:
    """Play commands (n_samples, 2) [V] and log every sample. Raises DeviceError, InterlockError."""
    rig, n_samples = sampling.rig, len(commands)
    sampling.begin(Mode.OPEN_LOOP)
    sent = done = 0
    while done < n_samples:
        room = rig.room()
        if sent < n_samples and room > 0:
            chunk = commands[sent : sent + room]
            rig.send(sent, chunk)
            sent += len(chunk)
            if done:
                sampling.timing.answered(done - 1)
        samples, trip = sampling.receive(n_samples)
        if len(samples) == 0:
            break
        done = sampling.keep(log, samples, (), trip, n_samples)
        if np.any(samples.flags & int(Flag.UNDERFLOW)):
            raise DeviceError(
                f"the device ran out of commands by sample {done - 1} and made itself safe; "
                "the host was too slow to refill it"
            )
    rig.stop()
