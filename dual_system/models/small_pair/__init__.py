"""What `checkpoints/small` needs beyond the paper; imported only where one of its folders declares it.

The demo's pair learned from scratch, so it reads one crop, tokens of the robot's state and cognition that is the code
of a place. Nothing else in the project may depend on this package, and it goes with that pair.
"""
