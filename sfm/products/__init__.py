"""What is made of surveys: drafts, refined models, epochs, inspection, plans, sheets and batches."""
