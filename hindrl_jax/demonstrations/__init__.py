"""demonstrations"""
