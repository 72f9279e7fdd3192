"""The three axes of one device, diagnosed together."""

import torch

import gyrofuse as gf


def test_the_axes_of_a_single_device_are_diagnosed_as_its_sensors():
    g = torch.Generator().manual_seed(5)
    signal, reference = (torch.randn(3, 1, 4200, dtype=torch.float64, generator=g) for _ in range(2))
    signal[1] += 0.3 * torch.sin(0.7 * torch.arange(4200, dtype=torch.float64))
    device, simulation = (gf.Recording(x, rate=100.0, axes=("x", "y", "z")) for x in (signal, reference))
    found = gf.diagnose(device, simulation)
    assert [finding.mechanism for finding in found.findings] == ["vibration_tone"]
    assert "sensor y" in found.findings[0].sentence
