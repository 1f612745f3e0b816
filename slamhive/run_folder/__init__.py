"""The life of a mapping run: its folder, its outcome, and the loop that moves it from state to state."""
