"""Common parts of both model servers: a process on the bus, an episode that the clock opens, a measured engine."""
