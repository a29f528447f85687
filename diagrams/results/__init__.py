"""Results of runs: recording, storage, plots and exports."""
