"""The paper's tables and figures on any data set: conditions, runs of them over drives, and tables of the results."""
