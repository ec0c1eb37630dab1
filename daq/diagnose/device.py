"""A rig's device before its first run: who answers, in time or not, and what it cannot promise."""

from daq.boards import loopback
from daq.boards.device import CardDevice
from daq.contract import opened
from daq.diagnose.computer import Check
from daq.diagnose.sampling import sampling_checks
from daq.errors import ConfigError, DeviceError
from daq.hal import Device, Disclosing


def diagnose_rig(
    device: Device, name: str, measure: bool, sample_rate: float | None = None
) -> list[Check]:
    """Check a rig's device by opening it and sampling for some seconds, outputs at zero.

    measure: move its motor's output, wired to an input, to see when outputs come. sample_rate
    [Hz]: to try. Raises ConfigError for a device of which that cannot be asked, and what ``open``
    raises.
    """
    if measure and not isinstance(device, CardDevice):
        cure = "leave --loopback out: what times its samples times its outputs as well"
        raise ConfigError("its backend is no card of another maker", cure=cure, file=name)
    with opened(device) as info:
        checks = [Check("rig", "good", info.name)]
        if measure and isinstance(device, CardDevice):
            checks.append(_phase(device))  # without which it plays nothing
        else:
            checks += sampling_checks(device, info, sample_rate)
    caveats = device.caveats() if isinstance(device, Disclosing) else []
    promise = [Check("promise", "could be better", item.problem, item.cure) for item in caveats]
    return [*checks, *promise]


def _phase(device: CardDevice) -> Check:
    try:
        delays = device.measure_phase()
        phase = loopback.phase(delays)
    except DeviceError as error:
        return Check("outputs", "bad", error.mistakes[0].problem, error.cure)
    ends = [round(value, 2) + 0.0 for value in (min(delays), max(delays))]  # no -0.00
    observation = (
        f"{ends[0]:.2f} to {ends[1]:.2f} samples behind the inputs, in "
        f"{len(delays)} starts at {loopback.RATE:g} Hz"
    )
    cure = f"write 'phase: {phase}' under options of the rig's file"
    return Check("outputs", "good", observation, cure)
