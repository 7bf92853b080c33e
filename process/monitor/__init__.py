"""The recorder's shared health to a page, metrics and a live bridge, in a process that cannot slow the recorder."""
