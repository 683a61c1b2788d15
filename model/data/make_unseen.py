"""Makes unseen.npz: the speakers whom simulated recordings play without computing them. About a minute.

python model/data/make_unseen.py
"""

from pathlib import Path

from tonguetrack.atomic import write_atomically
from tonguetrack.model.mri.phantom.articulation import PHONES
from tonguetrack.model.mri.phantom.unseen import SHIPPED, computed_speaker, unseen_file

if __name__ == "__main__":
    speakers = [computed_speaker(number, PHONES) for number in SHIPPED]
    print(write_atomically(Path(__file__).with_name("unseen.npz"), unseen_file(speakers)))
