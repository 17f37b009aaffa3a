"""Other people's policy servers as POUNCE: ``pounce-serve --backend openpi|groot|vla-eval|lerobot``."""
