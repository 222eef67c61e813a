"""A cache of tensors that is bounded in bytes."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable
from threading import Lock

from torch import Tensor

ENTRY = 500  # of the objects of an entry [bytes], measured


class TensorCache:
    """Cache of the most recently used tensors, by keys that hold a text; in another process it begins empty.

    Args:
        most: upper bound of its memory [bytes]; a tensor that alone exceeds it is not kept.
    """

    def __init__(self, most: int) -> None:
        self._most, self.size = most, 0  # [bytes]
        self._entries: OrderedDict[Hashable, tuple[Tensor, int]] = OrderedDict()
        self._lock = Lock()

    def __reduce__(self) -> tuple[type[TensorCache], tuple[int]]:
        return TensorCache, (self._most,)

    def get(self, text: str, make: Callable[[], Tensor], *options: Hashable) -> Tensor:
        """Return the tensor of a text and further options; `make` computes one that is not there."""
        key = (text, *options)
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key][0]
        made = make()
        size = made.nbytes + 4 * len(text) + ENTRY
        with self._lock:
            if key not in self._entries:
                self._entries[key] = made, size
                self.size += size
            while self.size > self._most:
                self.size -= self._entries.popitem(last=False)[1][1]
        return made
