"""A report of eval as tests need it: small, over two backgrounds, with something missing."""

from __future__ import annotations

from typing import Any


def small_report() -> dict[str, Any]:
    """Return a document such as ``metrics.json`` holds."""
    missing = {"value": None, "reason": "no weights <here>", "searched": ["/a"]}
    aggregate = {
        "psnr": 26.123456,
        "psnr_float": 26.2,
        "ssim": 0.91,
        "ms_ssim": {"value": 0.95, "reason": None, "searched": []},
        "lpips_alex": missing,
        "flicker": {"value": 0.0213, "reason": None, "searched": []},
        "flicker_true": {"value": 0.0125, "reason": None, "searched": []},
        "flicker_excess": {"value": 0.0088, "reason": None, "searched": []},
    }
    frames = [
        {"name": "r_000", "time": 0.0, "psnr": 25.123456, "ssim": 0.9, "ms_ssim": 0.94},
        {"name": "r_001", "time": 0.5, "psnr": 27.123456, "ssim": 0.92, "ms_ssim": 0.96},
    ]
    return {
        "schema": 1,
        "protocol": {
            "split": "test",
            "resolution": [200, 160],
            "downscale": 4,
            "background": "white",
            "checkpoint": "last",
            "checkpoint_step": 3000,
            "progress": 1.0,
            "device": "cpu",
            "processor": "A <fast> & small CPU",
            "gpu": None,
            "preset": "dnerf",
            "motion": "multiscale",
            "seed": 0,
            "data_fingerprint": "abc123",
            "conventions": {"psnr": "of everything"},
            "versions": {"gsdmsr": "0.1.0", "python": "3.11.2", "torch": "2.13.0"},
        },
        "aggregate": aggregate,
        "parts": {},
        "frames": frames,
        "splits": {
            "test": {"psnr": 26.123456, "frames": 2},
            "train": {"psnr": 30.0, "frames": 20},
            "val": {"psnr": None, "frames": 3},
        },
        "backgrounds": {
            "black": {"aggregate": aggregate | {"psnr": 24.5}, "parts": {}, "frames": frames}
        },
        "speed": {"fps": 100.0, "fps_raster": 200.0, "frames": 9, "warm_up_frames": 3},
        "storage": {
            "checkpoint_bytes": 4_000_000,
            "splats_bytes": 1_000_000,
            "motion_bytes": 500_000,
            "training_state_bytes": 2_400_000,
        },
        "training": {
            "steps": 3000,
            "train_s": 97.25,
            "splats": 1234,
            "load_s": 2.5,
            "compile_s": 0.5,
            "stages_s": {"gradients": 60.0, "optimizer": 30.0, "population": 2.0, "other": 5.25},
        },
    }
