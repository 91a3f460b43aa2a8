"""Bodies on MuJoCo: robots that are to run forward and whose reward lies, and a pendulum without a lie."""
