"""Small sample recordings of synthetic speakers, each with its truth; see make_recordings.sh."""
