"""Make `python_packages.json`: what packages of others give for the inputs of this folder.

Run in this folder's parent with `python -m published.make_python_packages`, in an environment that has them:
pip install allantools==2024.6 arch==8.0.0 PyWavelets==1.9.0 statsmodels==0.15.0
"""

from __future__ import annotations

import json
from pathlib import Path

import pywt
from allantools import edf_greenhall
from arch.bootstrap import optimal_block_length
from statsmodels.stats.sandwich_covariance import S_hac_simple

from published import memories, series

N_SERIES = 24


def main() -> None:
    coefficients = pywt.wavedec(series(), "haar", level=11)[:0:-1]
    longer = memories(N_SERIES, 2**14)
    parts = {
        "haar": {
            "source": "PyWavelets 1.9.0, wavedec(series, 'haar', level=11): first 8 coefficients of levels 1 to 11.",
            "coefficients": [level[:8].tolist() for level in coefficients],
        },
        "block_length": {
            "source": "arch 8.0.0, optimal_block_length for the circular bootstrap, of 24 series of 256 samples.",
            "lengths": [optimal_block_length(x)["circular"].item() for x in memories(N_SERIES, 256)],
        },
        "long_run_variance": {
            "source": "statsmodels 0.15.0, S_hac_simple with Bartlett's weights up to lag 256, of 24 longer series.",
            "variances": [float(S_hac_simple(x[:, None] - x.mean(), nlags=256)[0, 0]) / len(x) for x in longer],
        },
        "degrees_of_freedom": {
            "source": "allantools 2024.6, edf_greenhall of the overlapped Allan variance at 2^k of 4096 samples.",
            **{
                name: [float(edf_greenhall(alpha, 2, 2**k, 4097, overlapping=True)) for k in range(11)]
                for name, alpha in (("white_noise", 0), ("random_walk", -2))
            },
        },
    }
    (Path(__file__).parent / "python_packages.json").write_text(json.dumps(parts, indent=1) + "\n")


if __name__ == "__main__":
    main()
