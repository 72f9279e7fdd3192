"""Command `demo`: simulate an array, fuse it, and compare the results with the truth."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Annotated

import torch
import typer
from torch import Tensor

from gyrofuse._base.files import output_folder
from gyrofuse.cli.console import progress, say
from gyrofuse.cli.demo.mismatch import concealed, mismatch_story
from gyrofuse.cli.demo.models import CANDIDATES, models_figure, models_story, true_models
from gyrofuse.cli.options import Writing, takes_options
from gyrofuse.fitting.ranking.rank import rank_models
from gyrofuse.fitting.report.ranking import rank_report
from gyrofuse.fusion import plots as plotting
from gyrofuse.fusion.report.page import fusion_figure, fusion_report, new_figure, number, save_figure, verdict
from gyrofuse.fusion.result import SVOResult
from gyrofuse.fusion.svo import fit_svo
from gyrofuse.fusion.weights.svo import svo_weights
from gyrofuse.io.recording import Recording
from gyrofuse.mismatch.reporting.text import found_words, headline
from gyrofuse.noise.array_model import ArrayModel
from gyrofuse.noise.parsing import model_from_dict

if TYPE_CHECKING:
    from matplotlib.figure import Figure

RATE, UNIT = 10.0, "deg/s"  # Hz, and unit of the signals, of the simulated array, as in the paper
N_SAMPLES = 1_044_000  # 29 h at 10 Hz, the length of the paper's recordings
SEED = 20_220_601  # of all random numbers of the demonstration; arbitrary

FILES = ("report.html", "result.json", "models.html", "models.json", "mismatch.html", "mismatch.json", "figures")


def demo_array() -> ArrayModel:
    """Six gyros of Zhang et al., section V-B, Case 2: rates in deg/s at 10 Hz.

    White noise with covariance R, and three AR(1) processes whose innovations have the covariances P1, P2 and P3.
    """
    model = model_from_dict(json.loads(Path(__file__).with_name("array.json").read_text(encoding="utf-8")))
    assert isinstance(model, ArrayModel)
    return model


@takes_options
def demo(
    *,
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write to.")] = Path("gyrofuse-demo"),
    writing: Writing,
) -> None:
    """Watch it work on a simulated array.

    Needs no file and no network. The truth is known, and what is found is compared with it. With --force an earlier
    demonstration in DIR is replaced as well.
    """
    with writing.files() as files, output_folder(out, own=FILES, force=writing.force) as folder:
        with progress("simulating, fusing and drawing"):
            story = run_demo(folder)
        for option, name in (("json", "result.json"), ("report", "report.html")):
            if option in files.paths:
                shutil.copyfile(folder / name, files.draft(option))
    pages = {"Report": "report.html", "Noise models": "models.html", "Mismatch": "mismatch.html", "Figures": "figures"}
    say("\n".join([f"{story}\n", *(f"{name}: {out / file}" for name, file in pages.items())]))


def run_demo(folder: Path, n_samples: int = N_SAMPLES) -> str:
    """Simulate the array, fuse it, find noise models and a concealed effect, and write the results.

    Args:
        folder: Existing folder, to which `FILES` are written.
        n_samples: Number of samples of the simulated recording.

    Returns:
        Description of the simulation and of the results.
    """
    from gyrofuse.mismatch import diagnose

    array, generator = demo_array(), torch.Generator().manual_seed(SEED)
    signal = array.simulate(n_samples, generator=generator)
    recording = Recording(signal, rate=RATE, unit=UNIT)
    long, short = (fit_svo(recording, scale_weights) for scale_weights in ("long", "short"))
    truth = array.wavelet_cross_covariance(long.n_levels)
    remarks = _remarks(long, truth)
    title = f"Six simulated gyros, fused for long averaging times: {_at_best(long, truth)}"
    virtual = long.virtual(recording)
    report = fusion_report(long, recording, virtual, title=title, remarks=remarks)
    together = Recording(
        torch.cat([signal, virtual[None]]), rate=RATE, unit=UNIT, sensors=(*recording.sensors, "virtual")
    )
    models, truths = rank_models(together, CANDIDATES), true_models(array, long.weights)
    title = "Noise models of six simulated gyros and of the virtual gyro"
    pages = {"report.html": report, "models.html": rank_report(models, together, title=title)}
    other = concealed(array, n_samples, RATE, UNIT, generator)
    mismatch = diagnose(other, array)
    title = f"What a simulation of six gyros lacks: {found_words(mismatch)}"
    mismatch.to_html(folder / "mismatch.html", title=title)
    for name, page in pages.items():
        (folder / name).write_text(page, encoding="utf-8")
    for name, result in (("result.json", long), ("models.json", models), ("mismatch.json", mismatch)):
        (folder / name).write_text(json.dumps(result.to_dict()) + "\n", encoding="utf-8")
    figures = folder / "figures"
    figures.mkdir()
    drawn = {
        "long": fusion_figure(long),
        "short": fusion_figure(short),
        "truth": _truth_figure(long, short, truth),
        "models": models_figure(models, truths),
    }
    for name, figure in drawn.items():
        save_figure(figure, figures / f"{name}.png", "png")
    stories = (
        _story(long, short, truth, remarks),
        models_story(models, truths),
        mismatch_story(other, mismatch),
        "\n".join(
            fill(words, 110, subsequent_indent="  ")
            for words in (
                "In short:",
                f"- Fused, the six gyros have an {_at_best(long, truth)}.",
                f"- Of the simulation that lacks something: {headline(mismatch)}",
            )
        ),
    )
    return "\n\n".join(stories)


def _gain(weights: Tensor, wccv: Tensor) -> Tensor:
    """Allan deviation with these weights over that of the plain mean, per level."""
    return (torch.einsum("i,jik,k->j", weights, wccv, weights) / wccv.mean((-1, -2))).sqrt()


def _at_best(long: SVOResult, truth: Tensor) -> str:
    """Where the fitted weights gain most, by the true noise: they are best of all weights in one sum of levels."""
    ratio = _gain(long.weights, truth)
    level, less = int(ratio.argmin()), 100 * (1 - float(ratio.min()))
    where = f"at {number(long.tau[level].item())} s"
    return f"Allan deviation up to {less:.0f} % lower than that of their mean, {where}"


def _remarks(long: SVOResult, truth: Tensor) -> list[str]:
    low, high = long.confidence_interval
    best = svo_weights(truth, long.scale_weights)
    covered = int(((low <= best) & (best <= high)).sum())
    fitted, possible = (100 * (1 - _gain(weights, truth)[-1].item()) for weights in (long.weights, best))
    hours = long.n_samples / RATE / 3600
    return [
        f"The array is simulated: six gyros at {RATE:g} Hz for {number(hours, 3)} h ({long.n_samples} samples each) "
        "with white noise and three drifts that correlate between the sensors, as in Case 2 of Zhang, Cucci, Molinari "
        "and Guerrier (2022), section V-B. The fit is told nothing about the noise.",
        f"The truth is known here: the best weights for long averaging times are "
        f"{', '.join(f'{weight:.3f}' for weight in best.tolist())}; the intervals hold {covered} of {len(best)}. "
        f"With the true noise in place of this recording, the fitted weights make the Allan deviation at "
        f"{number(long.tau[-1].item())} s {fitted:.0f} % lower than that of the plain mean; the best possible is "
        f"{possible:.0f} %.",
    ]


def _story(long: SVOResult, short: SVOResult, truth: Tensor, remarks: list[str]) -> str:
    about, against_truth = remarks
    best = svo_weights(truth, long.scale_weights)
    low, high = long.confidence_interval
    weights = [f"{'sensor':>6}  {'weight':>8}  {'95 % interval':>18}  {'truth':>8}"]
    for name, *row in zip(long.sensors, *(c.tolist() for c in (long.weights, low, high, best)), strict=True):
        weight, lowest, highest, true = row
        weights.append(f"{name:>6}  {weight:>+8.4f}  [{lowest:+.4f}, {highest:+.4f}]  {true:>+8.4f}")
    columns = {
        "tau (s)": long.tau,
        "best sensor": (2 * long.wavelet_variance.amin(-1)).sqrt(),
        "plain mean": (2 * long.equal_wavelet_variance).sqrt(),
        "fused, short": (2 * short.virtual_wavelet_variance).sqrt(),
        "fused, long": (2 * long.virtual_wavelet_variance).sqrt(),
        "long/mean": (long.virtual_wavelet_variance / long.equal_wavelet_variance).sqrt(),
        "in truth": _gain(long.weights, truth),
        "possible": _gain(best, truth),
    }
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    levels = ["  ".join(f"{name:>12}" for name in columns)]
    levels += ["  ".join(f"{value:>12.4g}" for value in row) for row in rows]
    paragraphs = [
        fill(about, 110),
        "Weights for long averaging times:\n" + "\n".join(weights),
        f"Allan deviation ({UNIT}), that of fused gyros as expected in other recordings (cross-fitted); then long\n"
        "over mean: as expected, with the same weights and the true noise (in truth), with the best weights and the\n"
        "true noise (possible):\n" + "\n".join(levels),
        "\n".join(fill(f"- {sentence}", 110, subsequent_indent="  ") for sentence in verdict(long)),
        fill(against_truth, 110),
    ]
    return "\n\n".join(paragraphs).replace("\N{NO-BREAK SPACE}", " ")


def _truth_figure(long: SVOResult, short: SVOResult, truth: Tensor) -> Figure:
    """Expected and true ratios to the plain mean with the fitted weights, and these weights beside the best ones."""
    figure = new_figure(7, 7)
    *above, below = figure.subplots(3, 1, height_ratios=[1.3, 1.3, 1])
    for ax, result, name in zip(above, (long, short), ("long", "short"), strict=True):
        ratio = (result.virtual_wavelet_variance / result.equal_wavelet_variance).sqrt()
        plotting.plot_ratio(result.tau, ratio, ax=ax)
        ax.lines[-1].set_label("expected in other recordings")
        best = svo_weights(truth, result.scale_weights)
        for weights, dashes, label in ((result.weights, "--", "same weights, true noise"), (best, ":", "best weights")):
            ax.plot(result.tau, _gain(weights, truth), dashes, color="black", linewidth=1.2, label=label, zorder=6)
        ax.legend(fontsize=8, frameon=False, loc="lower left")
        ax.set_title(f"Fused for {name} averaging times", loc="left", fontsize=9)
    plotting.plot_weights(long.weights, *long.confidence_interval, names=long.sensors, ax=below)
    best = svo_weights(truth, long.scale_weights)
    below.plot(range(len(best)), best, "D", color="black", markerfacecolor="none", markersize=9, zorder=5)
    below.set_xlabel("sensor, fused for long averaging times; diamonds: best weights for the true noise")
    figure.align_ylabels()
    return figure
