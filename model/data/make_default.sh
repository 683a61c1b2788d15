#!/bin/sh
# Makes default.npz, the bundled synthetic model, from a phantom set of MRI scans. Run it in an empty folder with
# tonguetrack and its extra `mri` installed: 137 scans, a quarter of an hour of two cores. tests/test_bundled.py compares the
# model with these commands, and runs them in a nightly run.
set -eu
tonguetrack mri phantom heads --seed 0
tonguetrack mri build heads/dataset.toml -o default.npz --name "tonguetrack synthetic tongue"
