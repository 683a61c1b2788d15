"""What tongues can look like: meshes, the multilinear model, its files. No clock, no device."""

if __name__ != "tonguetrack.model":
    raise ImportError("import tonguetrack.model (the checkout's folder is mapped below that name)")
