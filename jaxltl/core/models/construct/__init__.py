"""Construction of models: conversion, restriction, lifting, batches of products, and counts."""
