"""Learn which averaging times SVO should stress for an error that matters downstream: the angle after a horizon.

The scale weights are the softmax of one logit a level. They turn the wavelet cross-covariance of an array at rest into
the weights of its sensors, differentiably; what is minimised over many simulated arrays is the error of the angle that
the virtual gyro, still at rest, gathers during a horizon in a later stretch of the recording, its bias being known from
the horizon before. The sensors of every array have white noise, AR1s and random walks of sizes of their own. Each array
counts by the logarithm of its mean square error: otherwise the noisiest would be all that counts.

Lightning's Trainer trains, the epoch that is best on validation arrays is kept, and arrays not seen before judge it
against the scale weights made by hand, and against all the weight on the level nearest to the horizon.

    python examples/train_scale_weights.py [--horizon 60] [--out FOLDER] [--figure learnt.png] [--quick]
"""

from __future__ import annotations

import argparse
import logging
import math
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from scipy import stats
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

import gyrofuse as gf
from gyrofuse.fusion.weights.svo import resolve_scale_weights

N_SENSORS = 6
N_HORIZONS = 33  # of the later stretch: 32 angles, each with the bias of the horizon before
AT_ONCE = 32  # arrays simulated together, for memory
HAND_MADE = ("flat", "short", "long")


class LearntScaleWeights(L.LightningModule):
    """SVO with scale weights that are learnt.

    Args:
        n_levels: Number of levels J.
        learning_rate: Of Adam, in logits.
    """

    def __init__(self, n_levels: int, learning_rate: float = 0.1) -> None:
        super().__init__()
        self.save_hyperparameters()
        self.logits = nn.Parameter(torch.zeros(n_levels, dtype=torch.float64))  # flat

    @property
    def scale_weights(self) -> Tensor:
        """`(level,)`, sum 1."""
        return self.logits.softmax(0)

    def forward(self, wccv: Tensor) -> Tensor:
        """Map the wavelet cross-covariance `(..., level, sensor, sensor)` to weights `(..., sensor)`."""
        return gf.svo_weights(wccv, self.scale_weights)

    def training_step(self, batch: list[Tensor], _index: int) -> Tensor:
        wccv, angles = batch
        return log_error(self(wccv), angles).mean()

    def validation_step(self, batch: list[Tensor], _index: int) -> None:
        wccv, angles = batch
        self.log("validation_loss", log_error(self(wccv), angles).mean(), batch_size=len(wccv))

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=self.hparams.learning_rate)


def log_error(weights: Tensor, angles: Tensor) -> Tensor:
    """Logarithm of the mean square angle of the virtual gyro, `(array,)`.

    Args:
        weights: `(array, sensor)`.
        angles: What each sensor gathers in every horizon, `(array, sensor, horizon)`, deg; nothing in truth.
    """
    return torch.einsum("as,ash->ah", weights, angles).square().mean(-1).log()


def simulated(n_arrays: int, options: argparse.Namespace, seed: int) -> TensorDataset:
    """Arrays at rest: what their weights are computed from, and what judges these.

    The layers before the scale weights have nothing to learn, so every array passes them once, here.

    Returns:
        Wavelet cross-covariances `(array, level, sensor, sensor)` of the first stretch, and angles
        `(array, sensor, horizon)` of the second.
    """
    generator = torch.Generator().manual_seed(seed)
    to_wccv = nn.Sequential(gf.HaarFilterBank(options.levels), gf.CrossCovariance())
    length = round(options.horizon * options.rate)  # of a horizon, in samples

    def between(low: float, high: float, n: int) -> Tensor:
        u = torch.rand(n, N_SENSORS, generator=generator, dtype=torch.float64)
        return low * (high / low) ** u

    parts = []
    for start in range(0, n_arrays, AT_ONCE):
        n = min(AT_ONCE, n_arrays - start)
        phi = (-1 / (options.rate * between(5, 50, n))).exp()  # correlation times of 5 to 50 s
        noise = (
            gf.WhiteNoise(between(3e-3, 3e-2, n).square() * options.rate / 10)  # of 10 samples a second, deg/s
            + gf.AR1(phi, between(1e-4, 1e-3, n).square() * (1 - phi**2))
            + gf.RandomWalk(between(3e-6, 3e-5, n).square() * 10 / options.rate)
        )
        signal = noise.simulate(options.samples + N_HORIZONS * length, generator=generator)  # (array, sensor, time)
        first, second = signal.split([options.samples, N_HORIZONS * length], -1)
        means = second.unflatten(-1, (N_HORIZONS, length)).mean(-1)
        parts.append((to_wccv(first), options.horizon * means.diff()))
    return TensorDataset(*(torch.cat(tensors) for tensors in zip(*parts, strict=True)))


def trained(options: argparse.Namespace, folder: Path) -> tuple[LearntScaleWeights, Path]:
    """The module of the epoch that is best on validation arrays, and its checkpoint."""
    training = simulated(options.arrays, options, options.seed)
    validation = simulated(max(options.arrays // 2, 2), options, options.seed + 1)
    order = torch.Generator().manual_seed(options.seed)
    checkpoint = ModelCheckpoint(folder, "best", monitor="validation_loss", save_last=True)
    trainer = L.Trainer(
        accelerator="cpu",
        devices=1,
        max_epochs=options.epochs,
        callbacks=[checkpoint],
        logger=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(
        LearntScaleWeights(options.levels),
        DataLoader(training, batch_size=max(options.arrays // 8, 2), shuffle=True, generator=order),
        DataLoader(validation, batch_size=len(validation)),
    )
    best = Path(checkpoint.best_model_path)
    return LearntScaleWeights.load_from_checkpoint(best, map_location="cpu"), best


@dataclass(frozen=True)
class Ratio:
    """Error with some weights over that with the learnt ones, a mean over arrays of logarithms, with its interval."""

    error: float  # deg
    ratio: float
    low: float
    high: float


def compared(learnt: Tensor, wccv: Tensor, angles: Tensor, nearest: int) -> dict[str, Ratio]:
    """Errors by kind of weights, paired array by array with those of the learnt ones."""
    one = torch.zeros_like(learnt)
    one[nearest - 1] = 1
    kinds: dict[str, Any] = {name: name for name in HAND_MADE} | {f"level {nearest} alone": one, "learnt": learnt}
    weights = {"equal weights": gf.equal_weights(wccv)}
    weights |= {name: gf.svo_weights(wccv, scale_weights) for name, scale_weights in kinds.items()}
    errors = {name: log_error(value, angles) / 2 for name, value in weights.items()}  # of the root mean square
    found = {}
    for name, error in errors.items():
        difference = error - errors["learnt"]
        half = stats.t.ppf(0.975, len(error) - 1) * difference.std().item() / math.sqrt(len(error))
        middle = difference.mean().item()
        found[name] = Ratio(error.mean().exp().item(), *(math.exp(middle + d) for d in (0, -half, half)))
    return found


def verdict(found: dict[str, Ratio]) -> str:
    """Whether learning was worth it, against the best of what needs none."""
    rivals = {name: ratio for name, ratio in found.items() if name not in ("learnt", "equal weights")}
    best, ratio = min(rivals.items(), key=lambda item: item[1].error)
    low, middle, high = (100 * (value - 1) for value in (ratio.low, ratio.ratio, ratio.high))
    if low > 0:
        beaten, more = "beat", ""
    elif high < 0:
        beaten, more = "do NOT beat", "\nTrain on more arrays or for longer, or take the other."
    else:
        beaten, more = "do NOT beat", "\nThe arrays do not tell the two apart."
    return (
        f"The learnt scale weights {beaten} the best of the others ({best}) out of sample:\n"
        f"its error is {middle:+.2f} % [{low:+.2f}, {high:+.2f}] from theirs.{more}"
    )


def draw(path: Path, learnt: Tensor, found: dict[str, Ratio], options: argparse.Namespace) -> None:
    """Scale weights against averaging time, and the ratios with their intervals."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.2), layout="constrained")
    tau = 2.0 ** torch.arange(options.levels) / options.rate
    for name, colour in zip(HAND_MADE, ("#999999", "#e69f00", "#009e73"), strict=True):
        left.plot(tau, resolve_scale_weights(name, options.levels), color=colour, label=name)
    left.plot(tau, learnt, color="#0072b2", linewidth=2.4, marker="o", label="learnt")
    left.axvline(options.horizon, color="#d55e00", linestyle=":", label="horizon")
    left.set(xscale="log", xlabel="averaging time (s)", ylabel="scale weight")
    left.legend(frameon=False)
    others = {name: ratio for name, ratio in found.items() if name != "learnt"}
    for row, ratio in enumerate(others.values()):
        right.plot([ratio.low, ratio.high], [row, row], color="#0072b2")
        right.plot(ratio.ratio, row, "o", color="#0072b2")
    right.axvline(1, color="#000000", linewidth=0.8)
    right.set_yticks(range(len(others)), list(others))
    right.invert_yaxis()
    right.set_xlabel(f"error of the angle after {options.horizon:g} s, over that with learnt scale weights")
    figure.savefig(path, dpi=120)


def checked(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """The options, with those that `--quick` changes and the number of levels."""
    options = parser.parse_args()
    if options.quick:
        options.arrays, options.test_arrays, options.samples, options.epochs = 64, 64, 4096, 25
    for name, least in (("arrays", 4), ("test_arrays", 2), ("epochs", 1), ("samples", 64)):
        if getattr(options, name) < least:
            parser.error(
                f"--{name.replace('_', '-')}: expected a whole number >= {least}, got {getattr(options, name)}"
            )
    for name in ("horizon", "rate"):
        if not (math.isfinite(getattr(options, name)) and getattr(options, name) > 0):
            parser.error(f"--{name}: expected a number > 0, got {getattr(options, name)}")
    # The last levels hold fewer windows than there are sensors: the longest one asked for has four.
    options.levels = options.samples.bit_length() - 3
    length = round(options.horizon * options.rate)
    if not 1 <= length <= options.samples // 2:
        parser.error(
            f"--horizon: expected 1 to {options.samples // 2} samples, half of the stretch that gives the weights, "
            f"got {options.horizon:g} s x {options.rate:g} Hz = {length}; change it, --rate or --samples"
        )
    if not 0 <= options.seed < 2**31:
        parser.error(f"--seed: expected a whole number from 0 to 2**31 - 1, got {options.seed}")
    if options.out is not None and options.out.exists() and (not options.out.is_dir() or any(options.out.iterdir())):
        parser.error(f"--out: expected a new or empty folder, found something in {options.out}")
    if options.figure is not None and not options.figure.resolve().parent.is_dir():
        parser.error(f"--figure: expected a name in a folder that exists, got {options.figure}")
    return options


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--horizon", type=float, default=60.0, help="seconds over which the rate is integrated")
    parser.add_argument("--rate", type=float, default=10.0, help="samples a second")
    parser.add_argument("--samples", type=int, default=16_384, help="of the stretch that the weights are computed from")
    parser.add_argument("--arrays", type=int, default=400, help="to train on; half as many validate")
    parser.add_argument("--test-arrays", type=int, default=400)
    parser.add_argument("--epochs", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="folder of the checkpoints; by default none are kept")
    parser.add_argument("--figure", type=Path, help="where a figure goes")
    parser.add_argument("--quick", action="store_true", help="few small arrays, in seconds")
    options = checked(parser)

    # Lightning's advice on devices, workers of a loader and logging intervals is for larger work than this.
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="lightning")
    with tempfile.TemporaryDirectory() as scratch:
        module, checkpoint = trained(options, options.out or Path(scratch))
    learnt = module.scale_weights.detach()

    test = simulated(options.test_arrays, options, options.seed + 2)
    nearest = min(max(round(math.log2(2 * options.horizon * options.rate)), 1), options.levels)
    found = compared(learnt, *test.tensors, nearest)

    print(f"{N_SENSORS} gyros; weights from {options.samples / options.rate:g} s, {options.levels} levels")
    print(f"{'averaging time (s)':>20}  {'learnt':>7}" + "".join(f"  {name:>7}" for name in HAND_MADE))
    columns = [learnt, *(resolve_scale_weights(name, options.levels) for name in HAND_MADE)]
    for level, row in enumerate(torch.stack(columns, -1).tolist()):
        print(f"{2**level / options.rate:>20g}" + "".join(f"  {value:>7.4f}" for value in row))
    print(f"\nAngle after {options.horizon:g} s at rest, {options.test_arrays} arrays not seen before:")
    print(f"{'scale weights':>20}  {'error (deg)':>11}  {'over learnt':>11}   95 % interval")
    for name, ratio in found.items():
        interval = f"[{ratio.low:.4f}, {ratio.high:.4f}]" if name != "learnt" else "-"
        print(f"{name:>20}  {ratio.error:>11.5f}  {ratio.ratio:>11.4f}   {interval}")
    print(verdict(found))
    if options.out is not None:
        print(f"The best epoch is in {checkpoint}.")
    if options.figure is not None:
        draw(options.figure, learnt, found, options)
        print(f"The figure is in {options.figure}.")


if __name__ == "__main__":
    main()
