"""The only room that imports mitsuba and drjit: label images and pictures."""
