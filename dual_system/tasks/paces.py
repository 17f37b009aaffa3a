"""StopCube's clock: without a simulator, for what learns from it."""

PASS_STEPS = (60, 80, 120)  # control steps of one pass of the running cube, whichever is drawn
PRESS_STEPS = 30  # the oracle begins to press so long before the cube is on the target
