"""Problems with known solutions, on which couplings are measured."""
