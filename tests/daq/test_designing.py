"""``rig design``: files that ``rig run`` runs, within limits, and what they would tell."""

import json
import shlex
import shutil

import numpy as np
import pytest
import yaml

from daq import record
from daq.config.yaml_file import TypedSettings
from daq.designs.bench import PlantBench
from daq.designs.knowledge import expected_jitter
from daq.designs.setup import set_up
from daq.experiment import RunFrame
from daq.logs.encoder import mean_speeds
from daq.lookup.classes import find_class
from daq.lookup.rigs import load_rig
from sim_rig.actuator import actuator
from tests.daq.support import few_free, merged, rig, write_experiment, write_yaml

QUICK = {"candidates": 10, "generations": 0, "draws": 1, "checks": 2, "calibration": 16}
QUESTION = {**QUICK, "time": "2.5 s", "config": "id.yaml", "targets": {"K_m": "1 %"}}
FRAME = RunFrame(1000, 800.0, (-5.0, 5.0), (0.0, 0.38))


@pytest.fixture
def asked(tmp_path):
    """A question on three parameters in a folder of its own."""
    write_yaml(tmp_path / "id.yaml", few_free())
    return write_yaml(tmp_path / "question.yaml", QUESTION)


def bench(margin=0.1, **changes):
    config, device = load_rig("simulated.yaml")
    limits = merged(config.limits.model_dump(), changes)
    config = config.model_copy(update={"limits": type(config.limits).model_validate(limits)})
    model = actuator(parameters="rig")
    plant = device.plant_model(5.0)
    return PlantBench(model, plant, config, 5.0, margin), model.nominal[None]


def commands(motor, brake=0.0):
    return np.tile([motor, brake], (400, 1))


@pytest.mark.parametrize("name", ["chirp", "multisine", "prbs", "sine", "steps"])
def test_all_of_a_family_are_runs_of_the_frames_length_within_the_ranges(name):
    protocol = find_class("protocol", name, None)
    family, rng = protocol.family(FRAME), np.random.default_rng(1)
    for place in (0.0, 1.0, *rng.random(6)):
        values = {
            key: free.low * (free.high / free.low) ** place if free.log
            else free.low + (free.high - free.low) * place
            for key, free in family.free.items()
        }  # fmt: skip
        content = {"protocol": name, "sample_rate": 800, **family.content(values)}
        waveform = protocol.model_validate(content).waveform()
        assert waveform.shape == (1000, 2)
        assert np.all(waveform >= [-5.0 - 1e-9, -1e-9])
        assert np.all(waveform <= [5.0 + 1e-9, 0.38 + 1e-9])


@pytest.mark.parametrize(
    ("limits", "motor"),
    [
        ({"current": {"motor": 0.5}}, 1.2),  # A of 0.6
        ({"speed": 20.0}, 1.2),
        ({"torque": 0.01}, 0.1),
        ({"winding": 4.99}, -0.3),
        ({"travel": [-1.0, 5.01]}, 1.2),
        ({"i2t": {"motor": {"continuous": 0.1, "budget": 0.01}}}, 0.6),
        ({"command": {"motor": [-0.5, 0.5]}}, 0.6),
        ({"encoder": {"acceleration": 200.0}}, 1.2),  # what a healthy shaft would not do
    ],
)
def test_a_run_beyond_any_limit_is_refused(limits, motor):
    within, vectors = bench()
    assert within.records(commands(motor), 1.0 / 800.0, vectors) is not None
    tight, _ = bench(**limits)
    assert tight.records(commands(motor), 1.0 / 800.0, vectors) is None


def test_a_run_is_logged_unless_a_limit_stops_it():
    roomy, vectors = bench()
    (record,) = roomy.records(commands(0.6), 1.0 / 800.0, vectors)
    logged = roomy.logged(commands(0.6), 1.0 / 800.0, vectors[0])
    assert np.array_equal(logged.inputs, record.inputs)
    assert bench(speed=20.0)[0].logged(commands(1.2), 1.0 / 800.0, vectors[0]) is None


def test_what_looks_like_a_blow_with_any_of_the_parameters_is_refused():
    loose, vectors = bench()
    inertias = [name in ("J_m", "J_b") for name in actuator().parameter_names]
    light = np.where(inertias, 0.3, 1.0) * vectors  # accelerates three times as fast
    motion = loose.signals(commands(0.6), 1.0 / 800.0, vectors)["omega"]
    peak = float(np.abs(np.diff(motion)).max() * 800.0)
    tight, _ = bench(encoder={"acceleration": 2.0 * peak})
    alike = np.repeat(vectors, 16, axis=0)
    mixed = np.vstack([alike[1:], light])
    assert loose.records(commands(0.6), 1.0 / 800.0, mixed) is not None
    assert tight.records(commands(0.6), 1.0 / 800.0, alike) is not None
    assert tight.records(commands(0.6), 1.0 / 800.0, mixed) is None


def test_a_limit_is_kept_by_the_margin():
    config = load_rig("simulated.yaml")[0]
    loose, vectors = bench()
    top = np.abs(loose.signals(commands(0.9), 1.0 / 800.0, vectors)["omega"]).max()
    for share, passes in ((1.12, True), (1.08, False)):
        tight, _ = bench(speed=share * float(top))
        records = tight.records(commands(0.9), 1.0 / 800.0, vectors)
        assert (records is not None) == passes, config.name


@pytest.mark.soak
def test_speeds_keep_the_margin_from_what_currents_can_make_of_them():
    shaken = commands(0.0)
    shaken[:, 0] = 1.5 * np.sin(2.0 * np.pi * 40.0 * np.arange(400) / 800.0)

    def least(margin):
        """Acceleration of an ampere that is needed for the run to pass."""
        low, high = 100.0, 4000.0
        while high - low > 5.0:
            middle = 0.5 * (low + high)
            careful, vectors = bench(margin, encoder={"acceleration": middle})
            passes = careful.records(shaken, 1.0 / 800.0, vectors) is not None
            low, high = (low, middle) if passes else (middle, high)
        return high

    # Some counts a sample are allowed beside it, whatever the margin.
    assert 1.25 <= least(0.2) / least(0.0) < 1.6


@pytest.mark.parametrize(
    ("volts", "margin", "passes"), [(0.22, 0.0, True), (0.22, 0.1, False), (0.25, 0.0, False)]
)
def test_an_amplifier_is_kept_from_the_end_of_its_supply_by_the_margin(volts, margin, passes):
    config, device = load_rig("simulated.yaml")
    model, noise = actuator(parameters="rig"), {"current_brake": 0.005, "omega": 0.1}
    plant = device.plant_model(5.0)
    careful, identified = (
        PlantBench(model, plant, config, 5.0, margin, noise, identified=later)
        for later in (False, True)
    )
    step = commands(0.0, volts)  # at 0.25 V it ends: errors of a fifth of the noise
    step[:50] = 0.0
    vectors = np.tile(model.nominal, (5, 1))
    assert (careful.records(step, 1.0 / 800.0, vectors) is not None) == passes
    stiff = np.array(model.nominal)
    stiff[model.parameter_names.index("R_b")] *= 1.6
    of_one, of_some, of_most = (
        np.vstack([vectors[: 5 - n], np.tile(stiff, (n, 1))]) for n in (1, 2, 3)
    )
    if passes:
        assert careful.records(step, 1.0 / 800.0, of_some) is not None
        assert careful.records(step, 1.0 / 800.0, of_most) is None
        assert identified.records(step, 1.0 / 800.0, vectors) is not None
        assert identified.records(step, 1.0 / 800.0, of_one) is None


def test_a_run_at_the_end_of_a_supply_takes_the_steps_that_it_needs():
    """At 2 V back EMF uses up the 24 V; by the steps that commands need it seemed to swing."""
    config, device = load_rig("simulated.yaml")
    values = {"K_dm": 106.0, "omega_dm": 662.0, "R_m": 1.19, "L_m": 8.6e-4, "K_m": 0.2}
    model = actuator(limits=True).with_parameters(**{k: {"nominal": v} for k, v in values.items()})
    noise = {"current_motor": 0.005, "omega": 0.1}
    careful = PlantBench(model, device.plant_model(5.0), config, 5.0, 0.1, noise)
    records = careful.records(commands(2.0, 0.02), 1.0 / 800.0, model.nominal[None])
    assert records is not None


@pytest.mark.parametrize(
    ("frequency", "identified", "passes"),
    [(200.0, True, False), (120.0, False, False), (120.0, True, True), (4.0, False, True)],
)
def test_a_shaft_that_turns_round_every_few_samples_tells_edges_no_speed(
    frequency, identified, passes
):
    config, device = load_rig("simulated.yaml")
    model, noise = actuator(parameters="rig"), {"current_motor": 0.005, "omega": 0.1}
    time = np.arange(400) / 800.0
    shaken = np.column_stack([0.1 + 0.9 * np.sin(2.0 * np.pi * frequency * time), np.zeros(400)])
    for timed in (False, True):
        careful = PlantBench(
            model, device.plant_model(5.0), config, 5.0, 0.1, noise, timed, identified
        )
        records = careful.records(shaken, 1.0 / 800.0, model.nominal[None])
        assert (records is not None) == (passes or not timed)
        assert (careful.turning, careful.strays) == (timed and not passes, 0)


def test_the_instants_of_edges_err_as_a_log_shows(tmp_path):
    log = record("chirp.yaml", options={"seed": 1}, out=tmp_path).frame
    tick, theta, omega = (log[name].to_numpy() for name in ("tick", "theta", "omega"))
    dt, count = 1.0 / 800.0, 2.0 * np.pi / 8192
    told = mean_speeds(tick, theta, omega, dt, count)
    expected = expected_jitter(omega, dt, count)
    change = np.gradient(omega, dt)
    # What edges known to rounding tell and what others do: by the mean of 1 / variance.
    for low, high in ((0.6, 2.0), (2.0, 5.0), (5.0, 20.0)):
        band = (np.abs(omega) >= low) & (np.abs(omega) < high) & np.isfinite(told.values)
        assert band.sum() > 50
        sizes = [
            np.mean(1.0 / (0.02**2 + (each * change)[band] ** 2))
            for each in (expected, told.jitter)
        ]
        assert sizes[0] == pytest.approx(sizes[1], rel=0.25)


def test_what_the_model_is_given_of_a_run_is_what_the_rig_would_log(tmp_path):
    loose, vectors = bench()
    (simulated,) = loose.records(commands(0.3, 0.05), 1.0 / 800.0, vectors)
    experiment = {
        "protocol": "steps", "homing": {"turns": 5}, "motor": {"levels": [0.3], "hold": 0.5},
        "brake": {"levels": [0.05], "hold": 0.5}, "name": "levels",
    }  # fmt: skip
    write_yaml(tmp_path / "levels.yaml", experiment)
    write_yaml(tmp_path / "rig.yaml", {"backend": "simulated", "options": {"ideal": True}})
    rig("run", "levels.yaml", "--rig", "rig.yaml", cwd=tmp_path)
    (log,) = tmp_path.glob("runs/*/log.csv")
    table = np.genfromtxt(log, delimiter=",", names=True)
    # The rig's brake has held the load; here it takes it first, and the mass rings on its cable.
    assert simulated.inputs[40:, 2] == pytest.approx(table["torque"][40:400], abs=2e-3)
    assert simulated.inputs[100:, 2] == pytest.approx(table["torque"][100:400], abs=1e-3)


@pytest.mark.soak
def test_a_design_writes_runs_a_figure_and_what_they_would_tell(asked, tmp_path):
    noisy = "--set", "noise.torque=0.05"
    done = rig("design", asked, "--out", "d", "--json", *noisy, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert json.loads((tmp_path / "d" / "design.json").read_text("utf-8")) == document
    assert (tmp_path / "d" / "design.png").stat().st_size > 10_000
    by_name = {quantity["name"]: quantity for quantity in document["quantities"]}
    assert by_name.keys() == {"R_m", "K_m", "B_m"}
    assert by_name["K_m"]["target"] == 0.01
    assert all(q["after"] < q["before"] for q in document["quantities"])
    # All else is fixed: nothing is tied, and B_m alone is hardly felt under so much noise.
    assert [u["names"] for u in document["unknown"]] == [["B_m"]] and not document["otherwise"]
    for run in document["runs"]:
        checked = rig("check", run["file"], "--json", cwd=tmp_path)
        assert json.loads(checked.stdout)["samples"] == 5000


MOST = ["--set", "targets.K_m=0.001"]  # asks for as many runs as the time holds


def printed_commands(text):
    """What stands behind Next and Then."""
    return [
        line.partition(": ")[2] for line in text.splitlines() if line[:6] in ("Next: ", "Then: ")
    ]


@pytest.mark.soak
def test_the_commands_of_a_design_lead_from_its_files_to_one_result(asked, tmp_path):
    designed = rig("design", asked, *MOST, "--out", "designs/d", cwd=tmp_path)
    assert designed.returncode == 0, designed.stderr
    commands = printed_commands(designed.stdout)
    assert [command.split()[1] for command in commands] == ["check", "run", "identify"]
    written = (tmp_path / "designs" / "d" / "commands.txt").read_text("utf-8")
    assert [line for line in written.splitlines() if line.startswith("rig ")] == commands
    checked, run, identified = (
        rig(*shlex.split(command)[1:], cwd=tmp_path, timeout=300) for command in commands
    )
    assert (checked.returncode, run.returncode, identified.returncode) == (0, 0, 0)
    assert checked.stdout.count("5000 samples at 4000 Hz") == 2
    assert printed_commands(checked.stdout) == commands[1:]
    assert printed_commands(run.stdout) == commands[2:]
    result = yaml.safe_load((tmp_path / printed_file(identified.stdout)).read_text("utf-8"))
    names = [log["name"] for log in result["metrics"]["training"]]
    assert [name.partition("-")[2] for name in names] == ["designed-1", "designed-2"]
    assert result["parameters"]["J_m"]["source"].startswith("id.yaml:")
    alone = rig("run", "designs/d/designed-1.yaml", cwd=tmp_path)
    assert printed_commands(alone.stdout) == commands[1:]
    there = rig("run", "designed-1.yaml", cwd=tmp_path / "designs" / "d")
    assert "whose runs are identified together: commands.txt" in there.stdout


def printed_file(text):
    """Where the parameters were written."""
    (line,) = [
        line for line in text.splitlines() if line.startswith("Parameters: ") and "/" in line
    ]
    return line.partition(": ")[2]


@pytest.mark.soak
def test_a_later_design_is_identified_with_the_logs_before_it(asked, tmp_path):
    rig("design", asked, "--out", "d", cwd=tmp_path)
    rig("run", "d", "--out", "runs/d", cwd=tmp_path)
    rig("identify", "runs/d", "--config", "id.yaml", "--out", "first", cwd=tmp_path)
    finer = ["--parameters", "first", "--set", "targets.K_m=0.01", "--out", "e"]
    again = rig("design", asked, *finer, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    last = printed_commands(again.stdout)[-1]
    logs = sorted(str(log.relative_to(tmp_path)) for log in tmp_path.glob("runs/d/*"))
    assert last == f"rig identify {' '.join(logs)} runs/e --config id.yaml --model actuator"
    for log in logs:
        shutil.rmtree(tmp_path / log)
    again = rig("design", asked, *finer[:-1], "f", cwd=tmp_path)
    last = printed_commands(again.stdout)[-1]
    assert (
        last
        == "rig identify runs/f --given first/parameters.yaml --config id.yaml --model actuator"
    )


@pytest.mark.soak
def test_what_is_printed_as_equal_is_met_and_what_is_narrowed_is_not_unknown(asked, tmp_path):
    first = rig("design", asked, "--json", "--out", "d", cwd=tmp_path)
    exact = {q["name"]: 100.0 * q["after"] for q in json.loads(first.stdout)["quantities"]}
    # Wanted: of K_m so little more than will be had that both print alike, of R_m far more.
    equal, finer = float(f"{exact['K_m']:.2g}"), 0.2 * exact["R_m"]
    for out, k_m in (("e", equal), ("f", equal / 1.001)):
        targets = ["--set", f"targets.K_m={k_m}", "--set", f"targets.R_m={finer}"]
        once = ["--set", "time=1.25 s", *targets]
        done = rig("design", asked, *once, "--out", out, cwd=tmp_path)
        document = json.loads((tmp_path / out / "design.json").read_text("utf-8"))
        quantities = {q["name"]: q for q in document["quantities"]}
        for name, wanted in (("K_m", k_m), ("R_m", finer)):
            after = float(f"{100.0 * quantities[name]['after']:.2g}")
            assert quantities[name]["met"] == (after <= wanted)
        short = [q["name"] for q in document["quantities"] if q["name"] in document["short"]]
        assert short == [name for name in ("R_m", "K_m") if not quantities[name]["met"]]
        assert not {"R_m", "K_m"} & {n for u in document["unknown"] for n in u["names"]}
        line = next(line for line in done.stdout.splitlines() if line.startswith("Narrowed, but"))
        assert all(name in line for name in short)


@pytest.mark.soak
def test_designed_files_are_right_from_any_folder(asked, tmp_path):
    write_yaml(tmp_path / "rig.yaml", {"backend": "simulated"})
    for place in ("d", "project/d"):
        done = rig("design", asked, "--rig", "rig.yaml", "--out", place, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        folder = tmp_path / place
        checked = rig("check", "designed-1.yaml", "--json", cwd=folder)
        assert checked.returncode == 0, checked.stderr
        first = (folder / "designed-1.yaml").read_text("utf-8").splitlines()[0]
        schema = folder / first.partition("$schema=")[2]
        assert "protocol" in json.loads(schema.read_text("utf-8"))["properties"]
        rig("schema", "project/schemas", cwd=tmp_path)
    assert "$schema=../schemas/experiment.json" in first


@pytest.mark.soak
def test_a_design_that_limits_stop_says_how_to_go_on(asked, tmp_path):
    rig("design", asked, *MOST, "--out", "d", cwd=tmp_path)
    slow = {"backend": "simulated", "limits": {"speed": 0.5}}
    write_yaml(tmp_path / "slow.yaml", slow)
    done = rig("run", "d", "--rig", "slow.yaml", "--out", "r", cwd=tmp_path)
    assert done.returncode == 1
    rest = "rig run d/designed-1.yaml d/designed-2.yaml --rig slow.yaml --out r"
    assert f"0 of 2 runs were completed; go on with: {rest}" in done.stderr


def test_a_design_is_not_written_over(asked, tmp_path):
    experiment = tmp_path / "d" / "designed-1.yaml"
    experiment.parent.mkdir()
    experiment.write_text("# mine\n")
    done = rig("design", asked, "--out", "d", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.endswith("d: a design is there; choose another with --out\n")
    assert experiment.read_text() == "# mine\n" and len(list(experiment.parent.iterdir())) == 1


def test_a_folder_without_a_design_is_refused(tmp_path):
    for command in ("run", "check"):
        done = rig(command, ".", cwd=tmp_path)
        assert done.returncode == 2
        assert "no design was written there; name an experiment's file, or a folder" in done.stderr


def test_several_experiments_are_checked_before_any_is_run(tmp_path):
    write_experiment(tmp_path / "wrong.yaml", sample_rat=800)
    done = rig("run", "prbs.yaml", "wrong.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert ": sample_rat: unknown key" in done.stderr
    assert not (tmp_path / "runs").exists()
    done = rig("run", "prbs.yaml", "sine.yaml", "--identify", cwd=tmp_path)
    assert done.returncode == 2
    assert "--identify: it identifies from one experiment" in done.stderr
    done = rig("run", "prbs.yaml", "sine.yaml", "--json", cwd=tmp_path)
    runs = json.loads(done.stdout)["runs"]
    assert [run["run"]["folder"].partition("-")[2] for run in runs] == ["prbs", "sine"]


def test_a_rig_that_an_experiment_names_in_vain_is_told_with_its_line(tmp_path):
    write_experiment(tmp_path / "e.yaml", rig="rig.yaml", sample_rat=1)
    text = (tmp_path / "e.yaml").read_text("utf-8").splitlines()
    line = {key: 1 + next(k for k, at in enumerate(text) if at.startswith(f"{key}:"))
            for key in ("rig", "sample_rat")}  # fmt: skip
    done = rig("check", "e.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert f"e.yaml:{line['rig']}:1: rig: rig.yaml: there is no such file; " in done.stderr
    assert f"e.yaml:{line['sample_rat']}:1: sample_rat: unknown key" in done.stderr


@pytest.mark.soak
def test_a_designed_run_passes_no_limit_and_is_identified(asked, tmp_path):
    asked = write_yaml(asked, QUESTION | {"sample_rate": 800})
    rig("design", asked, "--out", "d", cwd=tmp_path)
    done = rig("run", "d/designed-1.yaml", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    folder = json.loads(done.stdout)["run"]["folder"]
    identified = rig("identify", folder, "--config", "id.yaml", cwd=tmp_path)
    assert identified.returncode == 0, identified.stderr
    known = ["--parameters", folder, "--log", folder]
    met = rig("design", asked, *known, "--set", "targets.K_m=50", cwd=tmp_path)
    assert met.returncode == 2
    assert "known as well as that already" in met.stderr
    finer = ["--set", "targets.K_m=0.001", "--out", "e", "--json"]
    again = rig("design", asked, *known, *finer, cwd=tmp_path)
    assert "noise is assumed" not in again.stderr
    before, after = (
        json.loads((tmp_path / name / "design.json").read_text("utf-8")) for name in "de"
    )
    for first, second in zip(before["quantities"], after["quantities"], strict=True):
        assert second["before"] < first["before"]


def test_prior_from_a_result_has_its_deviations(tmp_path):
    write_yaml(tmp_path / "id.yaml", few_free())
    value = {"R_m": 1.1, "K_m": 0.15, "B_m": 2e-4}
    factor = [[0.011, 0.0, 0.0], [0.0, 0.003, 0.0], [0.0, 1e-3, 1e-5]]
    units = dict(zip(value, ("ohm", "N*m/A", "N*m*s/rad"), strict=True))
    result = {
        "parameters": {name: {"value": value[name], "unit": units[name]} for name in value},
        "covariance": {"parameters": list(value), "factor": factor},
    }
    (tmp_path / "result.yaml").write_text(yaml.safe_dump(result))
    files = {name: str(tmp_path / f"{name}.yaml") for name in ("id", "result")}
    setup = set_up(TypedSettings.of({"config": files["id"], "parameters": files["result"]}))
    exact = np.array(factor).T @ np.array(factor) / np.outer([*value.values()], [*value.values()])
    order = [setup.space.names.index(name) for name in value]
    assert setup.prior.values[order] == pytest.approx([*value.values()], rel=1e-3)
    assert setup.prior.covariance[np.ix_(order, order)] == pytest.approx(exact, rel=0.02)


def test_of_what_a_result_had_fixed_or_at_an_end_the_value_alone_is_taken(tmp_path):
    write_yaml(tmp_path / "id.yaml", few_free())
    value, units = {"R_m": 1.1, "K_m": 0.15, "B_m": 2e-4}, ("ohm", "N*m/A", "N*m*s/rad")
    entries = {
        name: {"value": value[name], "unit": unit} for name, unit in zip(value, units, strict=True)
    }
    entries["R_m"]["fixed"] = True
    covariance = {"parameters": ["K_m", "B_m"], "factor": [[0.003, 0.0]]}
    result = {"parameters": entries, "covariance": covariance}
    (tmp_path / "result.yaml").write_text(yaml.safe_dump(result))
    files = {name: str(tmp_path / f"{name}.yaml") for name in ("id", "result")}
    ranges = set_up(TypedSettings.of({"config": files["id"]})).prior
    setup = set_up(TypedSettings.of({"config": files["id"], "parameters": files["result"]}))
    known, names = setup.prior, setup.space.names
    order = [names.index(name) for name in value]
    assert known.values[order] == pytest.approx([*value.values()], rel=1e-3)
    before, after = (np.sqrt(np.diag(each.covariance))[order] for each in (ranges, known))
    assert after == pytest.approx([before[0], 0.02, before[2]], rel=1e-3)
    assert np.isfinite(known.information()).all()
    assert len(known.draws(setup.space, 3, np.random.default_rng(0))) == 3


def test_of_what_a_result_hardly_tells_ranges_decide_as_much(tmp_path):
    write_yaml(tmp_path / "id.yaml", few_free())
    files = {name: str(tmp_path / f"{name}.yaml") for name in ("id", "result")}
    ranges = set_up(TypedSettings.of({"config": files["id"]}))
    place = ranges.space.names.index("R_m")
    nominal, deviation = ranges.prior.values[place], ranges.prior.covariance[place, place] ** 0.5
    value = 1.5 * float(nominal)
    result = {
        "parameters": {"R_m": {"value": value, "unit": "ohm"}},
        "covariance": {"parameters": ["R_m"], "factor": [[value * float(deviation)]]},
    }
    (tmp_path / "result.yaml").write_text(yaml.safe_dump(result))
    setup = set_up(TypedSettings.of({"config": files["id"], "parameters": files["result"]}))
    # As far from either as from the other, and half of the variance.
    assert setup.prior.values[place] == pytest.approx(np.sqrt(nominal * value), rel=1e-6)
    assert setup.prior.covariance[place, place] == pytest.approx(0.5 * deviation**2, rel=1e-6)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"tagrets": {"K_m": 1}}, "question.yaml:1:1: tagrets: unknown key; did you mean"),
        ({"targets": {"K_m": 1}, "precision": 5}, "give targets or precision, not both"),
        ({"protocols": ["play"]}, "protocols.0: protocol play has no settings"),
        ({"run": "3 s", "time": "2 s"}, "run: a run of 3 s is longer than the 2 s of all"),
        ({"noise": {"x": 1.0}}, "noise.x: model actuator measures no x; it measures"),
        ({"targets": {"J_m": 5}, **QUICK}, "targets: J_m: no experiment tells it, for J_m, J_b"),
        ({"rig": "serial.yaml", "time": 5}, "name a model of the whole plant, such as --plant"),
        ({"time": 5, "plant": "lag"}, "plant: unknown model 'lag'; known are actuator"),
        ({"protocol": "prbs"}, "this file holds an experiment, and should hold a design's"),
    ],
)
def test_a_mistake_in_a_question_is_named_with_its_cure(content, words, tmp_path):
    write_yaml(tmp_path / "question.yaml", content)
    done = rig("design", "question.yaml", cwd=tmp_path)
    assert done.returncode == 2
    assert words in done.stderr
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "designs").exists()
