"""What both model servers do alike: a process on the bus, an episode that the clock opens, a measured engine."""
