"""Pages in a browser that a command serves."""

from typing import Protocol


class Page(Protocol):
    """A page served in a browser."""

    def run(self) -> None:
        """Serve the page until it is interrupted."""
        ...

    def close(self) -> None:
        """Stop serving."""
        ...


def serve_until_interrupted(page: Page) -> int:
    """Serve a page until Ctrl-C. Return the exit status."""
    try:
        page.run()
    except KeyboardInterrupt:
        pass
    finally:
        page.close()
    return 0
