#!/bin/sh
# Makes the sample recordings in this folder. Run it in an empty folder with tonguetrack installed;
# tests/test_bundled.py runs the same commands and compares.
set -eu

# Twelve seconds of phones, three coils on the tongue, and the palate: what `tonguetrack demo` plays.
tonguetrack simulate recording demo.csv --seconds 12 --phones "ə i ə ɑ ə u ə s a ʃ i ɔ ʉ ɛ s o" \
    --palate demo.palate.csv
tonguetrack track demo.csv --palate demo.palate.csv --save-session demo.session.toml

# Another speaker, five coils, and every coil lost 5 % of the time.
tonguetrack simulate recording dropouts.csv --speaker 2 --seconds 4 --dropouts 0.05 \
    --coils tongue_tip,tongue_blade,tongue_dorsum,tongue_left,tongue_right

# A third speaker whose head moves, with the coils on the head that show how.
tonguetrack simulate recording head-motion.csv --speaker 3 --seconds 4 --head-motion --rate 200 \
    --coils tongue_tip,tongue_blade,tongue_dorsum,head_nose,head_left,head_right
