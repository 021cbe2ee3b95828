"""Readers and writers of GLB, USDZ, SPZ and the other delivery formats."""
