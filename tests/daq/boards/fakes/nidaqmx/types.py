"""Types of the package."""

from typing import NamedTuple

from nidaqmx.constants import WatchdogAOExpirState


class AOExpirationState(NamedTuple):
    """Of an output, once the watchdog has expired."""

    physical_channel: str
    expiration_state: float
    output_type: WatchdogAOExpirState
