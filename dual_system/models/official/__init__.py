"""The official PonderPounce release: reads its checkpoint folder and writes ours."""
