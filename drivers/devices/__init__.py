"""Live devices: the bytes are understood by pure functions, and moved by `link`."""
