"""Question: how fast is phongfit, next to what people use instead?"""
