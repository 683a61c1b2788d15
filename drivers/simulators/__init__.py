"""Devices that are not there: they play recordings, as strictly and, if asked, as badly as real ones."""
