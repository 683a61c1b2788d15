#!/bin/sh
# Makes default.npz, the bundled synthetic model, from our own synthetic speakers. Run it in an empty folder
# with tonguetrack installed; tests/test_bundled.py runs the same commands and compares.
set -eu
tonguetrack model synthetic samples
tonguetrack model build samples/samples.yaml -o default.npz --name "tonguetrack synthetic tongue"
