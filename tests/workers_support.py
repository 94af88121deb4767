"""What worker processes of tests import."""


class Doubler:
    """A `ddgrasp.workers.Worker` of numbers."""

    def run(self, item: int) -> int:
        """Twice as much."""
        return 2 * item

    def close(self) -> None:
        """Nothing is held."""
