"""Products before their pixels: anchors, tiles, footprints."""
