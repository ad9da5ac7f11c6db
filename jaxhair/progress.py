"""How far long work is and how long it will still take, on the standard error."""

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

T = TypeVar("T")

SECONDS = 10.0
"""Between two lines, where there is no terminal to draw a bar on [s]."""


def _in_notebook() -> bool:
    """Whether a kernel runs this; that its package was imported does not say so."""
    ipython = sys.modules.get("IPython")
    return ipython is not None and hasattr(ipython.get_ipython(), "kernel")


class Progress:
    """A bar on a terminal or in a notebook; elsewhere a line now and then, and one at the end.

    Arguments:
        title: what is being done. total: how many units of work there are; None if it is not
            known, and then no time left is told. unit: name of one.
        shown: False shows nothing at all.

    A context manager, which closes it.
    """

    def __init__(self, title: str, total: int | None, *, unit: str, shown: bool = True) -> None:
        self.title, self.total, self.unit = title, total, unit
        self.done = 0
        self._shown, self._said = shown, ""
        self._began = self._told = time.monotonic()
        self._line = ""
        # the first unit of work has compilation in it, so it says little of the others
        self._first: tuple[float, int] | None = None
        self._bar: Any = None
        if shown and (sys.stderr.isatty() or _in_notebook()):
            from tqdm import tqdm

            self._bar = tqdm(total=total, desc=title, unit=unit, dynamic_ncols=True)

    def update(self, more: int = 1, said: str = "", *, total: int | None = None) -> None:
        """So many more units are done. `said`: how the work goes; `total`: of units, if it has
        changed."""
        self.done += more
        self.total = self.total if total is None else total
        self._said = said
        if self._bar is not None:
            self._bar.total = self.total
            if said:
                self._bar.set_postfix_str(said, refresh=False)
            self._bar.update(more)
            return
        now = time.monotonic()
        if self._shown and now - self._told >= SECONDS:
            self._told = now
            self._tell(now)
        if more and self._first is None:
            self._first = (now, self.done)

    def close(self) -> None:
        """Nothing more is done."""
        if self._bar is not None:
            self._bar.close()
        elif self._shown and self.done:
            self._tell(time.monotonic())
        self._shown, self._bar = False, None

    def _tell(self, now: float) -> None:
        of = "" if self.total is None else f"/{self.total}"
        parts = [f"{self.title}: {self.done}{of} {self.unit}s", f"{now - self._began:.0f} s"]
        if self.total is not None and self._first is not None and self.done < self.total:
            since, before = self._first
            if self.done > before:
                left = (now - since) / (self.done - before) * (self.total - self.done)
                parts.append(f"about {left:.0f} s left")
        parts += [self._said] if self._said else []
        line = ", ".join(parts)
        if line != self._line:  # the end may come just after a line that told it
            print(line, file=sys.stderr, flush=True)
        self._line = line

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def each(
    items: Sequence[T],
    title: str,
    *,
    unit: str,
    shown: bool,
    said: Callable[[T], str] = lambda item: "",
) -> Iterator[T]:
    """The items, with a bar that counts those that are done and says something of the present."""
    with Progress(title, len(items), unit=unit, shown=shown) as bar:
        for item in items:
            bar.update(0, said(item))
            yield item
            bar.update(1, said(item))
