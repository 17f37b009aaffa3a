"""A chat model that sees pictures, asked for the next subgoal: ``ponder-serve --backend openai`` (docs/planners.md)."""
