"""Experiments that a torque controller runs."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from pydantic import Field

from daq.experiment import Aboard, ClosedLoop, Evidence, SettingError, TripLimits
from daq.hal import FloatArray
from daq.lookup.controllers import TunedController, load_controller
from daq.progress import Progress, Watch, ignore
from haptics.evidence import Outcomes, Scene, family_margins, run_trials, weigh


class TorqueExperiment(ClosedLoop):
    """A closed loop whose commands are those of a controller that rig tune made."""

    torque_controller: str = Field(min_length=1, description="file that rig tune made")

    @cached_property
    def tuned_controller(self) -> TunedController:
        """The controller. Raises ConfigError for a file that holds none."""
        return load_controller(self.torque_controller, self._folder)

    @property
    def is_controlled(self) -> bool:
        """Whether it names a controller; some can do without."""
        return bool(self.torque_controller)

    def controller_remarks(self) -> tuple[str, ...]:
        """Which controller it is, and whether the torque sensor may judge it."""
        tuned = self.tuned_controller
        name = tuned.control.controller
        remarks = [f"Its {name} controller is {tuned.path}, tuned to {tuned.source}."]
        if tuned.control.takes_torque:
            remarks.append(
                "It listens to the torque sensor that judges it here: what noise and offset of the "
                "sensor do to the hand is not seen as an error."
            )
        return tuple(remarks)

    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lowest and highest commands of motor and brake, (2,) each [V].

        Raises SettingError where the controller is for another sample rate or delay.
        """
        control = self.tuned_controller.control
        for key, value in (("sample_rate", self.sample_rate), ("ahead", self.ahead)):
            tuned = getattr(control, key)
            if value != tuned:
                raise SettingError(
                    key,
                    f"{value:g}, but {self.torque_controller} was tuned for {tuned:g}; write "
                    f"{key}: {tuned:g}, or change it in the controller's settings and tune again",
                )
        motor, brake = self.tuned_controller.most_volts
        return np.array([-motor, 0.0]), np.array([motor, brake])

    def scenes(self) -> list[Scene]:
        """What its trials ask of the controller; none by default, and then no trials."""
        return []

    def evidence(self, limits: TripLimits, draws: int, watch: Watch = ignore) -> Evidence | None:
        """Trials of its scenes, each with a plausible actuator and hand, and margins.

        They end at the first tenth of the trials that speaks against the experiment.
        """
        scenes = self.scenes() if self.is_controlled else []
        if not scenes:
            return None
        walls = any(scene.wall is not None for scene in scenes)

        def refused(outcomes: Outcomes) -> bool:
            done = len(outcomes.results)
            watch(Progress("Simulated trials", done, draws, f"{done}/{draws}"))
            return bool(outcomes.failures(walls=walls))

        tuned = self.tuned_controller
        program = tuned.control.program(tuned.model, tuned.parameters)
        watch(Progress("Simulated trials", 0, draws, f"0/{draws}"))
        outcomes = run_trials(tuned, program, scenes, limits, draws, enough=refused)
        spread = bool(tuned.spread[0])
        return weigh(outcomes, family_margins(tuned), draws, spread, walls=walls)


class ReferenceExperiment(TorqueExperiment):
    """One whose torque is known beforehand, so that a device can close the loop by itself."""

    on_device: bool = Field(
        False,
        description="whether the device closes the loop, the same controller aboard; this "
        "computer sends references and supervises",
    )

    def controller_remarks(self) -> tuple[str, ...]:
        """Which controller it is, what may judge it, and where it runs."""
        if not self.on_device:
            return super().controller_remarks()
        return (
            *super().controller_remarks(),
            "It runs in the device's firmware (on_device); this computer sends references and "
            "watches the limits.",
        )

    def asked_of_device(
        self,
        reference: FloatArray,
        switches: Sequence[int],
        blend: float,
        logged: Sequence[FloatArray],
    ) -> Aboard:
        """What ``aboard`` returns on a device; blend: time in which the outputs move over [s]."""
        tuned = self.tuned_controller
        law = tuned.control.program(tuned.model, tuned.parameters).fingerprint
        samples = round(blend * self.sample_rate)
        return Aboard(law, reference, tuple(switches), samples, tuple(logged))
