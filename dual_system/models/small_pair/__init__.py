"""Extensions beyond the paper for `checkpoints/small`; imported only if one of its folders declares them.

The demo's pair was trained from scratch, so it reads one crop, tokens of the robot's state, and cognition that encodes
a place. Nothing else in the project may depend on this package; it is to be deleted with that pair.
"""
