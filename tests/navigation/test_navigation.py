"""Trajectories, strapdown navigation and the filter: against theory, and against an independent integration."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.integrate import solve_ivp

import gyrofuse as gf
from gyrofuse import navigation
from gyrofuse._base.units import GRAVITY
from gyrofuse.navigation import (
    Gnss,
    InitialUncertainty,
    State,
    Trajectory,
    UnitErrors,
    compare_filters,
    flight,
    navigate,
    read_trajectory,
    run_filter,
)
from gyrofuse.navigation.attitude import (
    conjugate,
    from_euler,
    from_rotation_vector,
    matrix,
    multiply,
    rotate,
    rotation_vector,
    skew,
)
from gyrofuse.navigation.trajectory import EARTH_RATE

DEGREE = math.pi / 180
NO_EARTH = torch.zeros(3, dtype=torch.float64)


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def start_of(trajectory: Trajectory) -> State:
    motion = trajectory.at(tensor(0.0))
    return State(motion.attitude[0], motion.velocity[0], motion.position[0])


def turn_between(p: torch.Tensor, q: torch.Tensor) -> float:
    return float(rotation_vector(multiply(p, conjugate(q))).norm())


def navigated(trajectory: Trajectory, rate: float, seconds: float) -> tuple[float, float, float]:
    """Errors of position, velocity and attitude after some seconds of ideal increments."""
    angle, push = (values[: round(seconds * rate)] for values in trajectory.increments(rate))
    out = navigate(start_of(trajectory), angle, push, 1 / rate, trajectory.earth_rate)
    truth = trajectory.at(tensor(len(angle) / rate))
    return (
        float((out.position[-1] - truth.position[0]).norm()),
        float((out.velocity[-1] - truth.velocity[0]).norm()),
        turn_between(out.attitude[-1], truth.attitude[0]),
    )


def test_quaternions_turn_as_matrices_do():
    generator = torch.Generator().manual_seed(0)
    phi = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    phi = 3 * phi / phi.norm(dim=-1, keepdim=True) * torch.rand(50, 1, generator=generator, dtype=torch.float64)
    phi[0] *= 1e-9
    q = from_rotation_vector(phi)
    torch.testing.assert_close(rotation_vector(q), phi, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(matrix(q), torch.linalg.matrix_exp(skew(phi)), rtol=1e-12, atol=1e-12)
    v = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    torch.testing.assert_close(rotate(q, v), (matrix(q) @ v[..., None])[..., 0])
    other = from_rotation_vector(phi.flip(0))
    torch.testing.assert_close(matrix(multiply(q, other)), matrix(q) @ matrix(other))


def test_euler_angles_turn_yaw_then_pitch_then_roll():
    roll, pitch, yaw = 0.3, -0.2, 1.1
    about = [tensor(0, 0, yaw), tensor(0, pitch, 0), tensor(roll, 0, 0)]
    one, two, three = (torch.linalg.matrix_exp(skew(v)) for v in about)
    torch.testing.assert_close(matrix(from_euler(tensor(roll, pitch, yaw))), one @ two @ three)


@pytest.mark.parametrize("latitude", [None, 0.8])
def test_what_the_unit_feels_gives_the_motion_back_in_an_independent_integration(latitude):
    trajectory = replace(flight(), latitude=latitude)
    earth = trajectory.earth_rate.numpy()

    def derivative(t: float, y: np.ndarray) -> np.ndarray:
        """C' = C W_ib - W_ie C, v' = C f + g - 2 w_ie x v, r' = v, by matrices."""
        motion = trajectory.at(tensor(t))
        c = y[:9].reshape(3, 3)
        w, f = motion.rate[0].numpy(), motion.specific_force[0].numpy()
        turning = c @ skew(torch.from_numpy(w)).numpy() - skew(torch.from_numpy(earth)).numpy() @ c
        velocity = y[9:12]
        push = c @ f + np.array([0, 0, GRAVITY]) - 2 * np.cross(earth, velocity)
        return np.concatenate([turning.ravel(), push, velocity])

    start = start_of(trajectory)
    first = np.concatenate([matrix(start.attitude).numpy().ravel(), start.velocity.numpy(), start.position.numpy()])
    out = solve_ivp(derivative, (0, 40), first, method="DOP853", rtol=1e-11, atol=1e-11).y[:, -1]
    truth = trajectory.at(tensor(40.0))
    np.testing.assert_allclose(out[:9], matrix(truth.attitude[0]).numpy().ravel(), atol=1e-7)
    np.testing.assert_allclose(out[9:12], truth.velocity[0], atol=1e-6)
    np.testing.assert_allclose(out[12:], truth.position[0], atol=2e-5)


@pytest.mark.statistical
def test_an_ideal_unit_gives_the_flight_back():
    position, velocity, attitude = navigated(replace(flight(), latitude=0.8), 100.0, 235.0)
    assert position < 1e-3
    assert velocity < 1e-4
    assert attitude < 1e-6


def test_errors_fall_with_the_third_power_of_the_interval():
    coarse, fine = (navigated(flight(), rate, 60.0) for rate in (20.0, 40.0))
    for worse, better in zip(coarse, fine, strict=True):
        assert worse / better == pytest.approx(8.0, rel=0.25)


def test_coning_does_not_make_the_attitude_drift():
    """The classic motion: an axis on a cone, which sums of angles take for a turn (Titterton and Weston, 11.3)."""
    half, speed, dt, n = 2.0 * DEGREE, 2 * math.pi * 8.0, 0.01, 1000
    t = torch.arange(n + 1, dtype=torch.float64) * dt
    slow = -2 * speed * math.sin(half / 2) ** 2 * dt
    angles = torch.stack(
        [
            torch.full((n,), slow, dtype=torch.float64),
            math.sin(half) * torch.cos(speed * t).diff(),
            math.sin(half) * torch.sin(speed * t).diff(),
        ],
        -1,
    )

    def attitude(time: torch.Tensor) -> torch.Tensor:
        zero = torch.zeros_like(time)
        return from_rotation_vector(half * torch.stack([zero, torch.cos(speed * time), torch.sin(speed * time)], -1))

    start = State(attitude(t[0]), torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    out = navigate(start, angles, torch.zeros_like(angles), dt, NO_EARTH)
    plain = start.attitude
    for angle in angles:
        plain = multiply(plain, from_rotation_vector(angle))
    drift = turn_between(plain, attitude(t[-1]))
    assert drift > 0.01
    # What two intervals cannot tell is of the second order in their length.
    assert turn_between(out.attitude[-1], attitude(t[-1])) < 0.25 * (speed * dt) ** 2 * drift


def test_sculling_does_not_make_the_velocity_drift():
    """Turning about one axis in step with a push along another makes a push along the third."""
    size, push, speed, dt, n = 1.0 * DEGREE, 5.0, 2 * math.pi * 6.0, 0.01, 1000

    def derivative(t: float, y: np.ndarray) -> list[float]:
        angle = size * math.sin(speed * t)  # about x; the push is along y of the body
        force = push * math.sin(speed * t)
        return [force * math.cos(angle), force * math.sin(angle)]

    truth = solve_ivp(derivative, (0, n * dt), [0, 0], method="DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    t = torch.arange(n + 1, dtype=torch.float64) * dt
    zero = torch.zeros(n, dtype=torch.float64)
    angles = torch.stack([size * torch.sin(speed * t).diff(), zero, zero], -1)
    pushes = torch.stack([zero, -push / speed * torch.cos(speed * t).diff(), zero], -1)
    start = State(tensor(1, 0, 0, 0), torch.zeros(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64))
    out = navigate(start, angles, pushes, dt, NO_EARTH)
    velocity = out.velocity[-1] - tensor(0, 0, GRAVITY * n * dt)
    assert truth[1] == pytest.approx(size * push / 2 * n * dt, rel=1e-3)
    np.testing.assert_allclose(velocity[1:].numpy(), truth, atol=0.03 * truth[1])


def unit(scale: float = 1.0) -> UnitErrors:
    gyro = gf.WhiteNoise((scale * 0.02 * DEGREE) ** 2) + gf.AR1(0.99, (scale * 1e-3 * DEGREE) ** 2)
    return UnitErrors(
        gyro + gf.RandomWalk((1e-5 * DEGREE) ** 2),
        gf.WhiteNoise((scale * 0.01) ** 2) + gf.RandomWalk(1e-5**2),
        50.0,
    )


def test_a_model_in_another_unit_is_that_of_the_signal_times_a_factor():
    model = gf.parse_model("WN(variance=2) + AR1(phi=0.9,variance=3) + RW(variance=1e-3) + SIN(amplitude=2,beta=0.3)")
    scaled = model.scaled(0.5)
    torch.testing.assert_close(scaled.wavelet_variance(8), 0.25 * model.wavelet_variance(8))
    names = dict(zip(scaled.param_names, scaled.params.tolist(), strict=True))
    assert names["sinusoid_1.amplitude"] == 1.0
    assert (names["sinusoid_1.beta"], names["ar1_1.phi"]) == (0.3, 0.9)
    with pytest.raises(ValueError, match="`factor`"):
        model.scaled(0.0)


@functools.cache
def flown(scale: float):
    """Forty flights of a filter that assumes the sensors' noise times a factor."""
    trajectory, assumed = flight(), unit(scale)
    errors = unit().simulate(60 * 50, 40, torch.Generator().manual_seed(3), with_states=True)
    initial = InitialUncertainty(attitude=(0.2 * DEGREE, 0.2 * DEGREE, 0.5 * DEGREE))
    generator = torch.Generator().manual_seed(4)
    return run_filter(
        trajectory, errors, assumed, gnss=Gnss(outage=(40.0, 50.0)), initial_uncertainty=initial, generator=generator
    )


def test_a_filter_that_assumes_the_truth_is_consistent():
    out = flown(1.0)
    total, count = float(out.nis.sum()), out.nis.numel() * 3
    low, high = stats.chi2.interval(0.999, count)
    assert low < total < high  # innovations are independent from fix to fix
    assert out.nis.shape == (50, 40)
    for state, size in enumerate(out.sizes):
        for second in (5.0, 20.0, 39.9, 50.0, 59.9):  # the end of the outage among them
            at = int((out.time - second).abs().argmin())
            low, high = stats.chi2.interval(0.9999, 40 * size)
            assert low < float(out.nees[at, :, state].sum()) < high
    off = (out.error / out.sd)[10::100].square().sum(1)  # (time, state), each state alone
    low, high = stats.chi2.interval(1 - 1e-3 / off.numel(), 40)
    assert off.shape[-1] == sum(out.sizes)
    assert bool(((off > low) & (off < high)).all())


def test_a_filter_starts_from_where_the_model_does():
    """A ramp is known from its first sample on: assumed of it, the filter takes it off."""
    gyro = gf.WhiteNoise((0.02 * DEGREE) ** 2) + gf.Drift(2e-4 * DEGREE)
    assumed = UnitErrors(gyro, gf.WhiteNoise(0.01**2), 50.0)
    errors = assumed.simulate(60 * 50, 40, torch.Generator().manual_seed(3))
    initial = InitialUncertainty(attitude=(0.2 * DEGREE, 0.2 * DEGREE, 0.5 * DEGREE))
    asked = {"gnss": Gnss(outage=(40.0, 50.0)), "initial_uncertainty": initial}
    out = run_filter(flight(), errors, assumed, generator=torch.Generator().manual_seed(4), **asked)
    low, high = stats.chi2.interval(0.9999, 120)
    end = int((out.time - 50.0).abs().argmin())
    assert all(low < total < high for total in out.nees[end, :, :3].sum(0).tolist())
    unaware = UnitErrors(gf.WhiteNoise((0.02 * DEGREE) ** 2), assumed.accelerometer, 50.0)
    lost = run_filter(flight(), errors, unaware, generator=torch.Generator().manual_seed(4), **asked)
    assert float(lost.nees[end, :, 0].sum()) > 10 * high


def test_a_filter_that_assumes_too_little_noise_shows_it():
    out = flown(0.1)
    assert float(out.nis.sum()) > stats.chi2.isf(0.01, out.nis.numel() * 3)  # the fixes' own errors are most of it
    end = int((out.time - 50.0).abs().argmin())
    attitude, velocity, position, sensors = out.nees[end].sum(0).tolist()
    assert attitude > stats.chi2.isf(1e-9, 120)
    assert min(velocity, position) > stats.chi2.isf(1e-6, 120)
    assert sensors > stats.chi2.isf(1e-9, 360)


def test_errors_grow_without_satellites_and_shrink_after():
    out = flown(1.0)
    length = out.position.norm(dim=-1).mean(-1)

    def at(second: float) -> float:
        return float(length[int((out.time - second).abs().argmin())])

    assert at(50.0) > 2 * at(39.9)
    assert at(55.0) < at(50.0) / 2


def test_the_same_model_costs_the_same_and_a_wrong_one_more():
    truth = gf.parse_model("AR1(phi=0.18,variance=1e-5) + RW(variance=2e-13)")
    wrong = gf.parse_model("AR1(phi=0.18,variance=1e-5) + RW(variance=2e-10)")
    short = Trajectory(flight().time[:8], flight().position[:8])
    asked = {"trajectory": short, "gnss": Gnss(outage=(60.0, 100.0)), "rate": 20.0, "n_flights": 60}
    same = compare_filters(truth, truth, **{**asked, "rate": 10.0, "n_flights": 4})
    assert "1.0000 (no interval: 5 flights at least) at" in same.summary()
    torch.testing.assert_close(same.ratio, torch.ones_like(same.ratio), rtol=0, atol=0)
    other = compare_filters(wrong, truth, **asked)
    when, ratio, low, high = other.peak
    assert 60 < when <= 100
    assert 1.0 < low < ratio < high
    assert "60 flights of 105 s" in str(other)
    assert other.to_dict()["peak"]["ratio"] == ratio
    assert len(other.plot().lines) >= 2


def test_an_outage_after_the_flight_is_none():
    truth = gf.parse_model("AR1(phi=0.18,variance=1e-5) + RW(variance=2e-13)")
    wrong = gf.parse_model("AR1(phi=0.18,variance=1e-5) + RW(variance=2e-10)")
    short = Trajectory(flight().time[:6], flight().position[:6])
    asked = {"trajectory": short, "rate": 10.0, "n_flights": 4}
    none, after = (compare_filters(wrong, truth, gnss=Gnss(outage=o), **asked) for o in (None, (160.0, 210.0)))
    assert after.outage is None
    assert after.peak[:2] == none.peak[:2]
    assert float(after.ratio.max()) == after.peak.ratio
    assert math.isnan(after.peak.low)  # four flights do not tell how far off it may be
    assert after.to_dict()["peak"]["low"] is None
    assert compare_filters(wrong, truth, gnss=Gnss(outage=(60.0, 210.0)), **asked).outage == (60.0, 75.0)


def test_limits_of_the_peak_know_that_it_was_chosen():
    """Two filters that are wrong by as much: the largest of many ratios is above one, its limits are not."""
    truth = gf.parse_model("AR1(phi=0.18,variance=1e-5) + RW(variance=2e-11)")
    more, less = (gf.parse_model(f"AR1(phi=0.18,variance=1e-5) + RW(variance=2e-{k})") for k in (10, 12))
    short = Trajectory(flight().time[:8], flight().position[:8])
    asked = {"trajectory": short, "gnss": Gnss(outage=(60.0, 100.0)), "rate": 20.0, "n_flights": 12, "truth": truth}
    one, other = compare_filters(more, less, **asked).peak, compare_filters(less, more, **asked).peak
    assert min(one.low, other.low) < 1.0
    assert max(one.ratio, other.ratio) > 1.0
    assert all(peak.low < peak.ratio <= peak.high for peak in (one, other))


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"rate": 0.0}, "`rate`"),
        ({"rate": -1.0}, "`rate`"),
        ({"sd": 1.0}, "`sd`: expected three numbers"),
        ({"sd": (1.0, -1.0, 1.0)}, "`sd`: expected three numbers"),
        ({"outage": (210.0, 160.0)}, "`outage`: expected its start and a later end"),
    ],
)
def test_fixes_that_cannot_be_are_refused(options, says):
    with pytest.raises(ValueError, match=says):
        Gnss(**options)


@pytest.mark.parametrize(("rate", "of_fixes"), [(0.3, 1.0), (20.0, 50.0), (20.0, 3.0)])
def test_fixes_between_samples_are_refused(rate, of_fixes):
    model = gf.WhiteNoise(1e-6)
    with pytest.raises(ValueError, match="`gnss`: expected fixes a whole number of the unit's samples apart"):
        compare_filters(model, model, rate=rate, gnss=Gnss(rate=of_fixes), n_flights=2)


def test_models_for_each_flight_are_those_of_the_flights():
    truth = gf.AR1(0.18, 1e-5) + gf.RandomWalk(2e-13)
    each = truth.with_params(truth.params.expand(6, -1).clone())
    short = Trajectory(flight().time[:6], flight().position[:6])
    asked = {"trajectory": short, "gnss": Gnss(outage=None), "rate": 10.0, "n_flights": 6}
    one, all_ = compare_filters(truth, truth, **asked), compare_filters(each, each, truth=truth, **asked)
    torch.testing.assert_close(one.position, all_.position)
    with pytest.raises(ValueError, match="`model`: expected one model, or one for each of 5 flights"):
        compare_filters(each, truth, **{**asked, "n_flights": 5})


def test_bad_trajectories_are_refused(tmp_path):
    t = torch.arange(8, dtype=torch.float64)
    place = torch.stack([10 * t, t, -t], -1)
    with pytest.raises(ValueError, match="`time`: expected at least 6 points"):
        Trajectory(t[:4], place[:4])
    with pytest.raises(ValueError, match="`time`: expected increasing seconds"):
        Trajectory(t.flip(0), place)
    with pytest.raises(ValueError, match=r"`position`: expected shape \(8, 3\)"):
        Trajectory(t, place[:, :2])
    with pytest.raises(ValueError, match="`position`: expected finite numbers"):
        Trajectory(t, place * torch.nan)
    with pytest.raises(ValueError, match=r"more than 0.5 m/s over ground, got 0; give `euler`"):
        Trajectory(t, torch.zeros(8, 3, dtype=torch.float64)).at(t)
    with pytest.raises(ValueError, match=r"a pitch of at most pi/2, got a pitch of 5; degrees\?"):
        Trajectory(t, place, place.new_full((8, 3), 5.0))
    with pytest.raises(ValueError, match=r"`latitude`: expected rad, at most pi/2, got 47; degrees\?"):
        Trajectory(t, place, latitude=47.0)
    with pytest.raises(TypeError, match="`time`: expected a torch tensor, got list"):
        Trajectory([0, 1], place)  # type: ignore[arg-type]
    path = tmp_path / "t.csv"
    path.write_text("time,north\n0,1\n")
    with pytest.raises(ValueError, match="found no east, down"):
        read_trajectory(path)
    path.write_text("time,north,east,down\n0,1,2\n")
    with pytest.raises(ValueError, match="expected as many columns as names, 4, found 3"):
        read_trajectory(path)
    path.write_text("\n".join(["time,north,east,down,roll,pitch", *(f"{i},{9 * i},0,0,0,0" for i in range(8))]))
    with pytest.raises(ValueError, match="expected roll, pitch and yaw, or none of them, found roll and pitch alone"):
        read_trajectory(path)


def test_a_trajectory_is_read_from_a_table(tmp_path):
    path = tmp_path / "t.csv"
    rows = [f"{i},{10 * i},{i},{-i},0,0.1,{0.1 * i}" for i in range(8)]
    path.write_text("\n".join(["time,north,east,down,roll,pitch,yaw", *rows]))
    motion = read_trajectory(path).at(tensor(3.0))
    torch.testing.assert_close(motion.position[0], tensor(30, 3, -3))
    torch.testing.assert_close(motion.attitude[0], from_euler(tensor(0, 0.1, 0.3)))
    torch.testing.assert_close(motion.rate[0], tensor(-0.1 * math.sin(0.1), 0, 0.1 * math.cos(0.1)))


def test_roll_and_yaw_go_round():
    t = torch.arange(0, 60, 1.0, dtype=torch.float64)
    turned = 0.3 * t
    wrapped = torch.remainder(turned + math.pi, 2 * math.pi) - math.pi
    euler = torch.stack([wrapped, 0 * t, 0 * t], -1)
    rate = Trajectory(t, torch.stack([9 * t, 0 * t, 0 * t], -1), euler).at(torch.linspace(1, 58, 200)).rate
    torch.testing.assert_close(rate, tensor(0.3, 0, 0).expand_as(rate))


def test_at_rest_on_the_turning_earth_nothing_moves():
    t = torch.arange(0, 601, 1.0, dtype=torch.float64)
    zero = torch.zeros(len(t), 3, dtype=torch.float64)
    rest = Trajectory(t, zero, zero + tensor(0.1, 0.2, 0.3), latitude=0.8)
    first, ideal = rest.at(t[:1]), rest.increments(1.0)
    start = State(first.attitude[0], first.velocity[0], first.position[0])
    end = navigate(start, *ideal, 1.0, rest.earth_rate)
    assert float(end.position.norm(dim=-1).max()) < 1e-3  # m, after ten minutes at one sample a second
    with pytest.raises(ValueError, match=r"`angles` and `pushes`: expected \(..., interval, 3\) both"):
        navigate(start, ideal.angle[:0], ideal.velocity[:0], 1.0, rest.earth_rate)


def test_at_rest_the_unit_feels_the_earth_turn():
    t = torch.arange(8, dtype=torch.float64)
    zero = torch.zeros(8, 3, dtype=torch.float64)
    motion = Trajectory(t, zero, zero, latitude=0.8).at(t[:1])
    torch.testing.assert_close(motion.rate[0], EARTH_RATE * tensor(math.cos(0.8), 0, -math.sin(0.8)))
    torch.testing.assert_close(motion.specific_force[0], tensor(0, 0, -GRAVITY))


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("Alignment", "InitialUncertainty"),
        ("Flown", "FilterErrors"),
        ("emulate", "compare_filters"),
        ("fly", "run_filter"),
    ],
)
def test_old_names_work_with_a_warning(old, new):
    with pytest.warns(DeprecationWarning, match=f"gyrofuse.navigation.{old} is deprecated .* use .*{new}"):
        assert getattr(navigation, old) is getattr(navigation, new)


def test_old_arguments_work_with_a_warning():
    model = gf.WhiteNoise(1e-6)
    short = Trajectory(flight().time[:6], flight().position[:6])
    asked = {"trajectory": short, "rate": 10.0, "n_flights": 2}
    with pytest.warns(DeprecationWarning, match="argument `(against|alignment)` is deprecated"):
        old = compare_filters(model, against=model, alignment=InitialUncertainty(), **asked)
    torch.testing.assert_close(old.position, compare_filters(model, model, **asked).position)
