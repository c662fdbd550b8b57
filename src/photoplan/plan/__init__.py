"""Plans of products before any pixel is computed: anchors, tiles, footprints, source images, accuracy."""
