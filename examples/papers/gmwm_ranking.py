"""Which processes made a record: `rank_models` on the three simulations of Voirol et al., and on parts of them.

Every composition that is left when processes are taken out of a simulation is simulated and ranked among all that
make sense: how often the true one is chosen, how often it is chosen or named as equivalent, and what the wavelet
variance information criterion (WVIC) would choose. Before that, theory says which of them a record of this length can
show: a composition is taken for identified where 95 of 100 records give it a better criterion, at its true values,
than its closest rival has, and a test at its true frequency finds each sinusoid as often, with three cycles or more.
No method can do much better than this share. An AR1 with a time constant above half the record is the random walk
that it is there. Simulations 2 and 3 have 160 000 samples here, 10 000 000 in the paper: `--simulation 2 --samples
10000000 --not-shown-by 160000` ranks what only so many show, at some six seconds a record.

    python examples/papers/gmwm_ranking.py [--quick] [--simulation N] [--samples T] [--not-shown-by T] [--runs N]
        [--out FOLDER] [--seed N]
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import matplotlib.pyplot as plt
import torch
from _gmwm_study import SIMULATIONS
from _svo_study import arguments, figures_written, finish
from scipy import stats
from torch import Tensor

import gyrofuse as gf
from gyrofuse.fitting.ranking.candidates import Kinds, name_of, penalty, structure_of
from gyrofuse.fitting.ranking.spectra import Spectra, summed
from gyrofuse.fitting.spectral.tones import FEWEST_CYCLES
from gyrofuse.noise.processes import Process

N_SAMPLES = {1: 40_000, 2: 160_000, 3: 160_000}
N_RUNS, QUICK_RUNS, QUICK_SAMPLES, QUICK_PROCESSES = 200, 4, 20_000, 2
_AT_ONCE = 2**23
_LINE_LEVEL = 0.001
_IDENTIFIED = 0.95
_DRAWS = 10_000
_RAMP_ROUNDS = 3


@dataclass(frozen=True)
class Part:
    """A part of a simulation.

    Attributes:
        model: With values.
        name: Of the composition that it is at this length.
        share: Of records that prefer it to its closest rival.
        rival: Its name.
    """

    model: gf.Model
    name: str
    share: float
    rival: str


def kinds_at(model: gf.Model, n_samples: int) -> Kinds:
    """Types of the processes as a record of this length can show them."""
    kinds: Kinds = []
    for process in model.processes:
        kind: type[Process] = type(process)
        if isinstance(process, gf.AR1) and float(process.phi) > math.exp(-2 / n_samples):
            kind = gf.RandomWalk
        if kind is not gf.RandomWalk or kind not in kinds:
            kinds.append(kind)
    return kinds


def parts(simulation: gf.Model, n_samples: int, most: int) -> list[Part]:
    """All parts of a model with noise and at most so many processes in them, and what theory says of each."""
    found = []
    with_noise: dict[tuple[Process, ...], tuple[float, str]] = {}
    for n in range(1, min(most, len(simulation.processes)) + 1):
        for processes in itertools.combinations(simulation.processes, n):
            if all(isinstance(p, gf.Sinusoid) for p in processes):
                continue
            model = gf.Model(list(processes))
            name, noise = name_of(kinds_at(model, n_samples)), noise_of(model)
            own = tuple(noise.processes)
            if own not in with_noise:
                with_noise[own] = share_with_noise(noise, n_samples)
            share, rival = min(with_noise[own], share_with_tone(model, n_samples))
            found.append(Part(model, name, share, rival))
    return found


def noise_of(model: gf.Model) -> gf.Model:
    return gf.Model([p for p in model.processes if not isinstance(p, gf.Sinusoid)])


def share_with_noise(noise: gf.Model, n_samples: int) -> tuple[float, str]:
    """Least share of records that prefer the true noise, among those that could be taken for it."""
    kinds = kinds_at(noise, n_samples)
    drawn, truth = drawn_spectra(noise, n_samples)
    own = (drawn.energy / truth + drawn.bins.count * truth.log()).sum(-1)
    own += penalty(structure_of(kinds, held=True), n_samples)
    shares = [(1.0, "-")]
    for rival in rivals(kinds):
        variance = closest(rival, drawn)
        energy = drawn.energy
        if gf.Drift in rival:
            energy = drawn.without_ramp(variance)[2]
        other = (energy / variance + drawn.bins.count * variance.log()).sum(-1)
        other += penalty(structure_of(rival, held=True), n_samples)
        shares.append(((other > own).double().mean().item(), name_of(rival)))
    return min(shares)


def rivals(kinds: Kinds) -> list[Kinds]:
    """One process less, a random walk or white noise in place of an AR1, a drift in place of a random walk."""
    found = [kinds[:k] + kinds[k + 1 :] for k in range(len(kinds))]
    for k, kind in enumerate(kinds):
        limits = {gf.AR1: (gf.RandomWalk, gf.WhiteNoise), gf.RandomWalk: (gf.Drift,)}.get(kind, ())
        found += [[*kinds[:k], limit, *kinds[k + 1 :]] for limit in limits]
    return [
        rival for rival in found if set(rival) - {gf.Drift} and all(rival.count(v) == 1 for v in rival if v != gf.AR1)
    ]


def drawn_spectra(noise: gf.Model, n_samples: int) -> tuple[Spectra, Tensor]:
    """Spectra of many records, drawn from their law, and the true variances of their bins."""
    spectra = Spectra(torch.zeros(1, n_samples, dtype=torch.float64))
    count = spectra.bins.count
    density = noise.spectrum(torch.arange(n_samples, dtype=torch.float64) / (2 * n_samples))
    truth = summed(spectra.bins, density[None])[0] / count
    generator = torch.Generator().manual_seed(0)
    along = torch.randn(_DRAWS, len(count), dtype=torch.float64, generator=generator)  # the ramp
    across = 2 * torch._standard_gamma(((count - 1) / 2).clamp(min=1e-9).expand(_DRAWS, -1), generator=generator)
    spectra.energy = truth * (along.square() + across)
    spectra.cross = (truth * spectra.ramp).sqrt() * along
    spectra.count = count.expand(_DRAWS, -1)
    return spectra, truth


def closest(kinds: Kinds, drawn: Spectra) -> Tensor:
    """Variances `(1, bin)` of the noise of these kinds that is closest to the mean of records, a ramp taken out."""
    n_samples = drawn.bins.n_samples
    structure = structure_of([kind for kind in kinds if kind is not gf.Drift], held=True)
    mean = drawn.part(torch.tensor([0]))
    mean.energy = drawn.energy.mean(0, keepdim=True)
    grid = torch.linspace(0.05, 0.95, 8, dtype=torch.float64) * math.log(n_samples)
    starts = list(itertools.combinations((-1 / grid.exp()).exp().atanh().tolist(), len(structure.nonlinear)))
    variance = mean.energy
    for _ in range(_RAMP_ROUNDS if gf.Drift in kinds else 1):
        linear = (mean.energy.sum() / n_samples).expand(1, structure.n_linear)
        fits = [mean.fit(structure, linear, torch.tensor([start], dtype=torch.float64).view(1, -1)) for start in starts]
        variance = mean.variances(structure, max(fits, key=lambda fit: fit.log_likelihood.item()))
        if gf.Drift in kinds:
            mean.energy = drawn.without_ramp(variance)[2].mean(0, keepdim=True)
    return variance


def share_with_tone(model: gf.Model, n_samples: int) -> tuple[float, str]:
    """Share of records in which the weakest line stands out, and 0 where one has too few cycles."""
    needed = 2 * math.log(n_samples / 2 / _LINE_LEVEL)
    shares = [(1.0, "-")]
    for tone in (p for p in model.processes if isinstance(p, gf.Sinusoid)):
        amplitude, beta = float(tone.amplitude), torch.tensor([float(tone.beta)], dtype=torch.float64)
        height = amplitude**2 * n_samples / (2 * noise_of(model).spectrum(beta / (2 * math.pi)).item())
        enough = float(tone.beta) * n_samples / (2 * math.pi) > FEWEST_CYCLES
        shares.append((float(stats.ncx2.sf(needed, 2, height)) if enough else 0.0, "one SIN less"))
    return min(shares)


@dataclass(frozen=True)
class Rates:
    """How often a part was recognised.

    Attributes:
        right: Chosen.
        named: Chosen, or named as equivalent.
        wvic: Chosen by WVIC.
        others: What was chosen instead, most often first.
    """

    right: float
    named: float
    wvic: float
    others: list[tuple[str, int]]


def rates(part: Part, n_samples: int, n_runs: int, generator: torch.Generator) -> Rates:
    """Rank so many records of a part."""
    right = named = wvic = 0
    others: dict[str, int] = {}
    for first in range(0, n_runs, max(_AT_ONCE // n_samples, 1)):
        n = min(max(_AT_ONCE // n_samples, 1), n_runs - first)
        signal: Tensor = part.model.simulate(n_samples, batch=(n, 1), generator=generator)
        ranked = gf.rank_models(signal, line_alpha=_LINE_LEVEL, fit=False)
        place = ranked.candidates.index(part.name) if part.name in ranked.candidates else -2
        right += int((ranked.choice == place).sum())
        wvic += int((ranked.wvic_choice == place).sum())
        named += int(((ranked.choice == place) | (place >= 0) & ranked.equivalent[..., place]).sum())
        for name in ranked.names:
            if name != part.name:
                others[str(name)] = others.get(str(name), 0) + 1
    ordered = sorted(others.items(), key=lambda item: -item[1])
    return Rates(right / n_runs, named / n_runs, wvic / n_runs, ordered)


def study(number: int, n_samples: int, n_runs: int, most: int, seed: int, shown: int) -> list[tuple[Part, Rates]]:
    """Print the table of a simulation and return its identified parts, but for those that a shorter record shows."""
    print(f"\nSimulation {number}: {n_samples} samples, {n_runs} records of each composition")
    print(f"{'true structure_of':<26}{'chosen':>8}{'or equivalent':>15}{'WVIC':>8}{'at most':>10}  most often instead")
    found = []
    known = [part.share >= _IDENTIFIED for part in parts(SIMULATIONS[number], shown, most)] if shown else []
    for k, part in enumerate(parts(SIMULATIONS[number], n_samples, most)):
        if known and known[k]:
            continue
        if part.share < _IDENTIFIED:
            print(f"{part.name:<26}{'not identified':>31}{part.share:>10.3f}  closest: {part.rival}", flush=True)
            continue
        rate = rates(part, n_samples, n_runs, torch.Generator().manual_seed(1000 * seed + 100 * number + k))
        cells = f"{rate.right:>8.3f}{rate.named:>15.3f}{rate.wvic:>8.3f}{part.share:>10.3f}"
        print(f"{part.name:<26}{cells}  {', '.join(f'{n} {name}' for name, n in rate.others[:3])}", flush=True)
        found.append((part, rate))
    if not found:
        raise SystemExit("there is no composition to rank: records of this length show none that is asked for")
    total = [sum(getattr(rate, kind) for _, rate in found) / len(found) for kind in ("right", "named", "wvic")]
    least = min(rate.right for _, rate in found)
    print(f"mean: chosen {total[0]:.3f} (least {least:.3f}), or equivalent {total[1]:.3f}; WVIC {total[2]:.3f}")
    return found


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--simulation", type=int, choices=list(SIMULATIONS), help="this one alone")
    parser.add_argument("--samples", type=int, help="length of the records; 40 000 and 160 000 by default")
    parser.add_argument("--not-shown-by", type=int, default=0, help="only structures that this length does not show")
    parser.add_argument("--runs", type=int, help=f"records of each composition; {N_RUNS} by default")
    options = parser.parse_args()
    which = [options.simulation] if options.simulation else ([1] if options.quick else list(SIMULATIONS))
    n_runs = options.runs or (QUICK_RUNS if options.quick else N_RUNS)
    lengths = dict.fromkeys(N_SAMPLES, QUICK_SAMPLES) if options.quick else N_SAMPLES
    most = QUICK_PROCESSES if options.quick else max(len(model.processes) for model in SIMULATIONS.values())
    tables = {
        number: study(number, options.samples or lengths[number], n_runs, most, options.seed, options.not_shown_by)
        for number in which
    }
    heights = [len(table) for table in tables.values()]
    size = (8, 1.2 + 0.32 * sum(heights))
    figure, axes = plt.subplots(
        len(tables), 1, figsize=size, squeeze=False, height_ratios=heights, layout="constrained"
    )
    for ax, (number, table) in zip(axes[:, 0], tables.items(), strict=True):
        for kind, label, color, marker in (
            ("right", "spectral likelihood, Hannan-Quinn", "#0072b2", "o"),
            ("wvic", "WVIC", "#d55e00", "s"),
        ):
            ax.plot([getattr(rate, kind) for _, rate in table], range(len(table)), marker, color=color, label=label)
        ax.set_yticks(range(len(table)), [part.name for part, _ in table], fontsize=8)
        ax.axvline(0.95, color="#555555", linewidth=0.8, linestyle="--", label="95 % of the records")
        ax.set_xlim(-0.02, 1.02)
        ax.set_title(f"Simulation {number}", fontsize=10)
    axes[-1, 0].set_xlabel("share of records of which the true composition was chosen")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=8)
    finish(figure, options.out / "gmwm_ranking.png")
    figures_written(options.out, "gmwm_ranking.png")


if __name__ == "__main__":
    main()
