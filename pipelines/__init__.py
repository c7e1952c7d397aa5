"""Commands and pipelines: straight-line composition of what `recon` offers."""
