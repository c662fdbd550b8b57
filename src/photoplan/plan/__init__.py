"""Products before their pixels: anchors, tiles, coverage."""
