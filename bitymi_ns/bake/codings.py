"""Codings of texels that their last optimisation steps draw: BC7 pages, or the codes of a compact bundle."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from bitymi_ns.bake.baked import Baked, encoded_pages
from bitymi_ns.codec.pages import listed_texels, paged_texels
from bitymi_ns.codec.quantise import EncodedAtlas
from bitymi_ns.codec.texel_codes import TexelCodeOptions, TexelCoder, TexelCodes

TO_START = 0.93  # share of the bytes that coded texels may have before their last steps, in which they grow a little


class Coded(Protocol):
    """Texels as they are stored."""

    def texels(self) -> Tensor:
        """[T, 3] as they are drawn, in the order of `TexelTiles`."""
        ...


C = TypeVar("C", bound=Coded)


class Coding(Protocol[C]):
    """A way to store texels."""

    def first(self, texels: Tensor) -> C:
        """Code texels [T, 3] before the steps."""
        ...

    def again(self, texels: Tensor) -> C:
        """Code texels between steps, quickly."""
        ...

    def last(self, coded: C) -> C:
        """Final coding of the best texels."""
        ...


@dataclass(frozen=True)
class CosineTexels:
    """Texels as the codes of a compact bundle."""

    listed: Tensor  # [T, 3] what was coded
    codes: TexelCodes  # as they are stored

    def texels(self) -> Tensor:
        return self.codes.texels()


class Cosines:
    """The codes of a compact bundle, of no more bytes than the options say."""

    def __init__(self, coder: TexelCoder, options: TexelCodeOptions) -> None:
        self._coder, self._most = coder, options.most_bytes

    def first(self, texels: Tensor) -> CosineTexels:
        most = self._most
        coded = self._coder.code(texels) if most is None else self._coder.fit(texels, most * TO_START)
        return CosineTexels(texels.clone(), coded)

    def again(self, texels: Tensor) -> CosineTexels:
        return CosineTexels(texels.clone(), self._coder.code(texels, rounds=0))

    def last(self, coded: CosineTexels) -> CosineTexels:
        if self._most is None or coded.codes.nbytes() <= self._most:
            return coded
        return CosineTexels(coded.listed, self._coder.fit(coded.texels(), self._most, rounds=1))


@dataclass(frozen=True)
class PageTexels:
    """Texels in the pages of an atlas."""

    listed: Tensor  # [T, 3] what was encoded
    atlas: EncodedAtlas  # as it is stored
    drawn: Tensor  # [T, 3] as they are drawn: decoded, but for the constants of surfels without a tile

    def texels(self) -> Tensor:
        return self.drawn


class Pages:
    """An atlas in the format of the bake's options, in the range of values of the texels that come first."""

    def __init__(self, baked: Baked, first: Tensor) -> None:
        """
        Args:
            baked: with an atlas.
            first: [N] int64, the first texel of every surfel in the list.
        """
        assert baked.texels is not None
        self._baked, self._packing, self._options = baked, baked.packing, baked.options
        self._first, self._range = first, None

    def first(self, texels: Tensor) -> PageTexels:
        self._range = None
        coded = self.again(texels)
        self._range = coded.atlas.range
        return coded

    def again(self, texels: Tensor) -> PageTexels:
        pages = paged_texels(self._baked.cut(texels), self._packing, self._baked.texels)
        atlas = encoded_pages(pages, self._packing, self._options, value_range=self._range)
        drawn = listed_texels(torch.from_numpy(atlas.decoded()[..., :3]), self._packing, texels[self._first])
        return PageTexels(texels.clone(), atlas, drawn)

    def last(self, coded: PageTexels) -> PageTexels:
        return coded
