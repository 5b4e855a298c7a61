"""Many simulated calibrations of a five-camera rig: whether stated uncertainties are true."""
