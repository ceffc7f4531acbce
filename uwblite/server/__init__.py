"""The local page of `uwblite view`: results side by side, closures and anchors to correct, and the map made again."""
