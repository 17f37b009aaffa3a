"""What other projects' programs say and expect: their messages' bytes, and a policy's names for a robot's numbers."""
