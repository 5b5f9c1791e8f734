"""What hidden results say about a design: stakes, hack rates, verdicts."""
