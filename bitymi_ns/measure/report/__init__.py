"""Reports: one page of tables, plots and pictures from evaluations, training curves and benchmark cells."""
