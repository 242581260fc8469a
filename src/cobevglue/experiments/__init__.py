"""The paper's tables and figures on any data set: conditions, their runs on sequences, and tables of the results."""
