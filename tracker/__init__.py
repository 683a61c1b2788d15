"""Frame in, pose out, and onwards: the runtime. Uses drivers and model."""

if __name__ != "tonguetrack.tracker":
    raise ImportError("import tonguetrack.tracker (the checkout's folder is mapped below that name)")
