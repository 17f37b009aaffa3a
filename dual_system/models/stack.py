"""A ModuleList that knows the type of its layers; keys and behaviour are unchanged."""

from collections.abc import Iterator
from typing import Generic, TypeVar, cast

from torch import nn

Layer = TypeVar("Layer", bound=nn.Module)


class Stack(nn.ModuleList, Generic[Layer]):
    def __iter__(self) -> Iterator[Layer]:
        return cast(Iterator[Layer], super().__iter__())
