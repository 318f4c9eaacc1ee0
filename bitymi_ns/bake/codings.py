"""Codings of texels that their last optimisation steps draw: BC7 pages, or the codes of a compact bundle."""

from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.bake.baked import Baked, encoded_texels
from bitymi_ns.codec.pages import first_texels, listed_texels
from bitymi_ns.codec.quantise import EncodedAtlas
from bitymi_ns.codec.texel_codes import TexelCodeOptions, TexelCoder, TexelCodes

TO_START = 0.93  # share of the bytes that coded texels may have before their last steps, in which they grow a little
TO_FILL = 0.99  # share of the bytes that they are to have after these steps, where they fill them


@dataclass(frozen=True)
class Coded:
    """Texels as they are stored."""

    listed: Tensor  # [T, 3] what was coded
    texels: Tensor  # [T, 3] as they are drawn
    stored: EncodedAtlas | TexelCodes


class Cosines:
    """The codes of a compact bundle, of no more bytes than the options say."""

    def __init__(self, coder: TexelCoder, options: TexelCodeOptions) -> None:
        self._coder, self._most, self._fill = coder, options.most_bytes, options.fill

    def first(self, texels: Tensor) -> Coded:
        """Code texels [T, 3] before the steps."""
        if self._most is None:
            return self._coded(texels, self._coder.code(texels))
        if self._fill:
            self._coder.aim(self._coder.code(texels), self._most * TO_START)
        return self._coded(texels, self._coder.fit(texels, self._most * TO_START))

    def again(self, texels: Tensor) -> Coded:
        """Code texels between steps, quickly."""
        codes = self._coder.code(texels, rounds=0)
        if self._fill and self._most is not None:
            self._coder.aim(codes, self._most * TO_FILL)
        return self._coded(texels, codes)

    def last(self, coded: Coded) -> Coded:
        """Final coding of the best texels."""
        if self._most is None or coded.stored.nbytes() <= self._most:
            return coded
        return self._coded(coded.listed, self._coder.fit(coded.texels, self._most, rounds=1))

    def _coded(self, texels: Tensor, codes: TexelCodes) -> Coded:
        return Coded(texels.clone(), codes.texels(), codes)


class Pages:
    """An atlas in the format of the bake's options, in the range of values of the texels that come first."""

    def __init__(self, baked: Baked) -> None:
        self._baked, self._range = baked, None

    def first(self, texels: Tensor) -> Coded:
        """As `Cosines.first`."""
        self._range = None
        coded = self.again(texels)
        self._range = coded.stored.range
        return coded

    def again(self, texels: Tensor) -> Coded:
        """As `Cosines.again`."""
        baked, packing = self._baked, self._baked.packing
        atlas = encoded_texels(baked.cut(texels), packing, baked.options, value_range=self._range)
        constants = texels[first_texels(baked.sizes)]
        drawn = listed_texels(torch.from_numpy(atlas.decoded()[..., :3]), packing, constants)
        return Coded(texels.clone(), drawn, atlas)

    def last(self, coded: Coded) -> Coded:
        """As `Cosines.last`."""
        return coded
